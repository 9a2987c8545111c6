"""Training by PPO of Stable-Baselines3 on highway-env's 84 x 84 occupancy grids."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("torch", "gymnasium", "highway_env", "stable_baselines3")
PACKAGES = ("stable-baselines3", "highway-env", "gymnasium", "torch")

N_WORLDS, N_STEPS, N_EPOCHS, MINIBATCH = 8, 32, 4, 128


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Decisions of one iteration: rollout of all worlds and the updates on it. options: file of the environment"""
    import importlib.util
    import warnings

    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    spec = importlib.util.spec_from_file_location("environment", options["environment"])
    assert spec is not None
    assert spec.loader is not None
    environment = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(environment)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    config = {"config": environment.config("grids")}
    envs = make_vec_env("highway-v0", n_envs=N_WORLDS, seed=1, env_kwargs=config)
    sizes = {"n_steps": N_STEPS, "n_epochs": N_EPOCHS, "batch_size": MINIBATCH}
    model = PPO("CnnPolicy", envs, device="cpu", seed=1, **sizes)
    n_decisions = N_WORLDS * N_STEPS

    def iterate() -> int:
        model.learn(n_decisions, reset_num_timesteps=False)
        return n_decisions

    return iterate, {"n_worlds": N_WORLDS, **sizes, "n_weights": sum(p.numel() for p in model.policy.parameters())}
