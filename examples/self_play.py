"""Self-play with PettingZoo, supersuit and Stable-Baselines3: one policy learns to drive all cars that meet.

    python examples/self_play.py 40000

Needs `pip install -e ".[sb3,pettingzoo]"` and `pip install --no-deps supersuit tinyscaler`.
"""

import sys

import numpy as np
import supersuit
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecMonitor

import negopipe


def main(n_decisions: int, n_worlds: int = 8, n_steps: int = 64, overrides: tuple[str, ...] = ()) -> list[float]:
    """Train for some decisions of all agents; returns the agents' returns, in the order of the episodes' ends."""
    world = negopipe.make_parallel_env(["observation=objects", "policy=objects", *overrides])
    agents = supersuit.pettingzoo_env_to_vec_env_v1(supersuit.black_death_v3(world))
    envs = VecMonitor(supersuit.concat_vec_envs_v1(agents, n_worlds, base_class="stable_baselines3"))
    set_random_seed(1)  # the worlds of supersuit take no seed from PPO
    model = PPO("MlpPolicy", envs, n_steps=n_steps, batch_size=256, ent_coef=0.01, device="cpu")
    returns: list[float] = []

    def count(values: dict, _: dict) -> bool:
        returns.extend(info["episode"]["r"] for info in values["infos"] if "episode" in info)
        return True

    model.learn(n_decisions, callback=count)
    return returns


if __name__ == "__main__":
    paid = main(int(sys.argv[1]))
    tenth = max(1, len(paid) // 10)
    print(f"mean return of the first tenth {np.mean(paid[:tenth]):.2f}, of the last {np.mean(paid[-tenth:]):.2f}")
