"""negopipe's batched worlds, compiled, as its training steps them."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("torch", "negopipe", "negopipe.game.environment")
PACKAGES = ("torch",)


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Decisions with random actions of all worlds together, resets included. options: n_worlds, overrides"""
    import torch

    import negopipe
    from negopipe.game.environment import NegotiationEnv
    from negopipe.game.game import build_game
    from negopipe.runtime.backend import prepare
    from negopipe.simulation.scenario import TaskSampler

    config = negopipe.load_config("device=cpu", "compile=on", "n_threads=1", *options["overrides"])
    prepare(config)
    n_worlds, game, random = options["n_worlds"], build_game(config, is_compiled=True), torch.Generator().manual_seed(1)
    tasks = TaskSampler(config.scenario, config.evaluated_families, random, game.cast.assign)
    env = NegotiationEnv(game, config.reward, config.policy.horizons_s, tasks, n_worlds)

    def decide() -> int:
        env.step(torch.randint(env.n_actions, (n_worlds,), generator=random))
        return n_worlds

    return decide, {"observation": str(game.observation_shape), "n_worlds": n_worlds, "n_vehicles": 2}
