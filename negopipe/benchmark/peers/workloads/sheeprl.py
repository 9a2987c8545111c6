"""Training by PPO of sheeprl on highway-env's 84 x 84 occupancy grids.

sheeprl trains from start to end in one call. So it runs in a thread of its own, whose environments wait until the next
iteration is asked for.
"""

import threading
from collections.abc import Callable
from typing import Any

LIBRARIES = ("torch", "gymnasium", "highway_env", "sheeprl.cli", "sheeprl.algos.ppo.ppo")
PACKAGES = ("sheeprl", "highway-env", "gymnasium", "torch")

N_WORLDS, N_STEPS, N_EPOCHS, MINIBATCH = 8, 32, 4, 128
N_DECISIONS = N_WORLDS * N_STEPS
FOREVER = 100_000
"""Iterations; the process ends before."""


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Decisions of one iteration: rollout of all worlds and the updates on it.

    options: file of the environment. sheeprl writes files into the working folder
    """
    import sys
    import warnings

    import gymnasium
    import torch
    from sheeprl.cli import run

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    allowed, waiting = threading.Semaphore(0), threading.Semaphore(0)
    gymnasium.register("Gated-v0", entry_point=lambda **_: _gated(options["environment"], allowed, waiting))
    sys.argv[1:] = _arguments()  # which its Hydra reads
    thread = threading.Thread(target=run, daemon=True)
    thread.start()

    def until_waiting(n: int) -> None:
        for _ in range(n):
            while not waiting.acquire(timeout=1.0):
                if not thread.is_alive():
                    raise RuntimeError("sheeprl has ended")

    def iterate() -> int:
        allowed.release(N_DECISIONS)
        until_waiting(N_DECISIONS)  # at the first step of the next iteration: the updates are over
        return N_DECISIONS

    until_waiting(1)

    return iterate, {"n_worlds": N_WORLDS, "n_steps": N_STEPS, "n_epochs": N_EPOCHS, "batch_size": MINIBATCH}


def _gated(file: str, allowed: threading.Semaphore, waiting: threading.Semaphore) -> Any:
    """highway-env, each step of which waits until it is allowed."""
    import importlib.util

    import gymnasium

    spec = importlib.util.spec_from_file_location("environment", file)
    assert spec is not None
    assert spec.loader is not None
    environment = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(environment)

    class Gated(gymnasium.Wrapper):
        def step(self, action: Any) -> Any:
            waiting.release()
            allowed.acquire()
            return self.env.step(action)

    return Gated(gymnasium.make("highway-v0", config=environment.config("grids"), render_mode="rgb_array"))


def _arguments() -> list[str]:
    return [
        "exp=ppo",
        "env=gym",
        "env.id=Gated-v0",
        f"env.num_envs={N_WORLDS}",
        "env.sync_env=True",
        "env.capture_video=False",
        "env.screen_size=84",
        "env.grayscale=True",
        "algo.cnn_keys.encoder=[rgb]",
        "algo.mlp_keys.encoder=[]",
        f"algo.rollout_steps={N_STEPS}",
        f"algo.update_epochs={N_EPOCHS}",
        f"algo.per_rank_batch_size={MINIBATCH}",
        f"algo.total_steps={FOREVER * N_DECISIONS}",
        "algo.run_test=False",
        "metric.log_level=0",
        "checkpoint.every=0",
        "fabric.accelerator=cpu",
        "fabric.devices=1",
    ]
