"""negopipe's environments: every vehicle plans at every decision."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("torch", "gymnasium", "negopipe", "negopipe.envs.gymnasium")
PACKAGES = ("torch", "gymnasium", "numpy")


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Decisions with random actions of all worlds together, resets included.

    options: n_worlds, observation: grids or objects; through gymnasium, not compiled
    """
    import torch

    import negopipe

    torch.set_num_threads(1)
    n_worlds, observation = options["n_worlds"], options["observation"]
    overrides = ["observation=objects", "policy=objects"] if observation == "objects" else []
    envs = negopipe.make_vec_env(n_worlds, overrides)
    envs.reset(seed=1)

    def decide() -> int:
        envs.step(envs.action_space.sample())
        return n_worlds

    return decide, {"observation": str(envs.single_observation_space), "n_worlds": n_worlds, "n_vehicles": 2}
