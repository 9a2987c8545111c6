"""negopipe's simulator and training, compiled, as a run uses them."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("torch", "negopipe", "negopipe.training.training")
PACKAGES = ("torch",)


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Decisions of one iteration of training: rollout of all worlds and the updates on it. options: overrides"""
    import negopipe
    from negopipe.runtime.backend import prepare
    from negopipe.training.training import Training

    config = negopipe.load_config("device=cpu", "compile=on", "n_threads=1", *options["overrides"])
    prepare(config)
    training = Training(config)

    def iterate() -> int:
        training.iterate()
        return training.curve.n_per_iteration

    algorithm = config.algorithm
    n_weights = sum(weights.numel() for weights in training.policy.parameters())
    facts = {"n_worlds": algorithm.n_worlds, "n_steps": algorithm.n_steps, "n_weights": n_weights}
    return iterate, facts
