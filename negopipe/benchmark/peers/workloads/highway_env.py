"""highway-env: ten cars that follow the intelligent driver model around an ego, 84 x 84 occupancy grids or objects."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("gymnasium", "highway_env")
PACKAGES = ("highway-env", "gymnasium", "numpy")

GRID = {
    "type": "OccupancyGrid",
    "features": ["presence"],
    "grid_size": [[-21, 21], [-21, 21]],
    "grid_step": [0.5, 0.5],
    "as_image": True,
}
OBJECTS = {"type": "Kinematics", "vehicles_count": 10}


def config(observation: str) -> dict[str, Any]:
    """highway-v0 with two lanes, ten vehicles and five decisions per second, each of three steps of the simulation."""
    return {
        "observation": GRID if observation == "grids" else OBJECTS,
        "lanes_count": 2,
        "vehicles_count": 10,
        "policy_frequency": 5,
        "simulation_frequency": 15,
        "duration": 1000,
    }


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Decisions with random actions, resets included. options: observation: grids or objects"""
    import warnings

    import gymnasium
    import highway_env

    assert highway_env.__file__  # its import registers highway-v0
    warnings.simplefilter("ignore")
    env = gymnasium.make("highway-v0", config=config(options["observation"]))
    env.reset(seed=1)

    def decide() -> int:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
        return 1

    return decide, {"observation": str(env.observation_space), "n_worlds": 1}
