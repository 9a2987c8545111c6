"""VMAS: its scenario road_traffic, a batch of worlds in torch."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("torch", "vmas")
PACKAGES = ("vmas", "torch")

TWO_VEHICLES = {"n_agents": 2, "n_nearing_agents_observed": 1}


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Decisions with random actions, of all worlds together. options: n_worlds"""
    import torch
    import vmas

    torch.set_num_threads(1)
    n_worlds = options["n_worlds"]
    env = vmas.make_env("road_traffic", num_envs=n_worlds, device="cpu", seed=1, **TWO_VEHICLES)
    env.reset()

    def decide() -> int:
        _, _, done, _ = env.step([env.get_random_action(agent) for agent in env.agents])
        for world in done.nonzero()[:, 0].tolist():
            env.reset_at(world)
        return n_worlds

    return decide, {"n_worlds": n_worlds, "n_vehicles": len(env.agents)}
