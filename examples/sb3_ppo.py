"""Train with Stable-Baselines3's PPO on one of the two observations, and drive the result.

    python examples/sb3_ppo.py grids 20000
    python examples/sb3_ppo.py objects 20000

Grids are pictures for a CNN, objects rows of numbers for an MLP. Needs `pip install -e ".[sb3]"`.
"""

import sys

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import negopipe
from negopipe.envs.stable_baselines3 import Sb3VecEnv

OVERRIDES = {"grids": [], "objects": ["observation=objects", "policy=objects"]}
POLICIES = {"grids": "CnnPolicy", "objects": "MlpPolicy"}


def main(kind: str, n_decisions: int, n_worlds: int = 16, n_steps: int = 64) -> float:
    """Train for some decisions; returns the share of successes of one episode in each world."""
    given = ["+experiment=yield", *OVERRIDES[kind]]
    envs = VecMonitor(Sb3VecEnv(negopipe.make_vec_env(n_worlds, given)))
    model = PPO(POLICIES[kind], envs, n_steps=n_steps, batch_size=n_worlds * n_steps // 4, seed=1, device="cpu")
    model.learn(n_decisions)
    held = negopipe.make_vec_env(n_worlds, given)
    observation, _ = held.reset(seed=1000)
    is_success: dict[int, bool] = {}
    while len(is_success) < n_worlds:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, _, _, info = held.step(action)
        for world in np.flatnonzero(info.get("_final_info", [])):
            is_success.setdefault(int(world), bool(info["final_info"]["is_success"][world]))
    return sum(is_success.values()) / n_worlds


if __name__ == "__main__":
    print(f"success {main(sys.argv[1], int(sys.argv[2])):.0%}")
