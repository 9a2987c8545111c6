"""Self-play with Stable-Baselines3: one policy learns to drive all cars that meet, from the decisions of all of them.

    python examples/self_play.py 600000

The environments are the agents of `negopipe.make_parallel_env`, of many worlds in one batched program. Rows of CSV tell
the share of successes: `held` on tasks that training does not see, before and after, and `training` among the episodes
that ended meanwhile. Needs `pip install -e ".[sb3]"`.
"""

import sys
import time
from collections.abc import Iterator

import numpy as np
import torch
from stable_baselines3 import PPO

import negopipe
from negopipe.envs.stable_baselines3 import Sb3VecEnv

HELD_SEED = 100_000


def success(model: PPO, envs: Sb3VecEnv) -> list[bool]:
    """Whether the first episode of each world is a success; horizons are drawn, as in training."""
    envs.seed(HELD_SEED)
    seen, first = envs.reset(), dict[int, bool]()
    while len(first) < envs.num_envs:
        seen, _, over, infos = envs.step(model.predict(seen)[0])
        first = {agent: infos[agent].get("is_success", False) for agent in over.nonzero()[0]} | first
    return list(first.values())


def main(n_decisions: int, n_agents: int = 128, n_steps: int = 64, overrides: tuple[str, ...] = ()) -> Iterator[tuple]:
    """Train for some decisions of all agents; yields (tasks, decisions, minutes of a core, episodes, success rate)."""
    given = ["observation=objects", "policy=objects", *overrides]
    held, envs = (Sb3VecEnv(negopipe.make_vec_env(n_agents, given, is_self_play=True)) for _ in range(2))
    size = n_agents * n_steps // 8
    model = PPO("MlpPolicy", envs, 1e-3, n_steps, size, n_epochs=5, ent_coef=0.01, seed=1, device="cpu")
    driven, ended, begin = success(model, held), list[bool](), time.process_time()
    yield "held", 0, 0.0, len(driven), np.mean(driven)

    def count(values: dict, _: dict) -> bool:
        ended.extend(info["is_success"] for info in values["infos"] if "is_success" in info)
        return True

    while model.num_timesteps < n_decisions:
        ended.clear()
        model.learn(4 * n_agents * n_steps, callback=count, reset_num_timesteps=False)
        yield "training", model.num_timesteps, (time.process_time() - begin) / 60, len(ended), np.mean(ended)
    driven = success(model, held)
    yield "held", model.num_timesteps, (time.process_time() - begin) / 60, len(driven), np.mean(driven)


if __name__ == "__main__":
    torch.set_num_threads(1)
    print("tasks,decisions,cpu_minutes,episodes,success_rate")
    for row in main(int(sys.argv[1])):
        print("{},{},{:.2f},{},{:.3f}".format(*row), flush=True)
