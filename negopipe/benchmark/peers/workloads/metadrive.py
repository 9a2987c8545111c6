"""MetaDrive: its own traffic around an ego, observed by rays; it downloads its assets at its first start."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("metadrive",)
PACKAGES = ("metadrive-simulator", "numpy")


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Decisions with random actions, resets included."""
    from metadrive import MetaDriveEnv

    env = MetaDriveEnv({"use_render": False, "log_level": 50, "num_scenarios": 1, "traffic_density": 0.1})
    env.reset()

    def decide() -> int:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
        return 1

    return decide, {"observation": str(env.observation_space), "n_worlds": 1}
