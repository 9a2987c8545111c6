"""PythonRobotics' Frenet planner, from the user's own checkout: it is no package, and none of it is here."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("numpy", "scipy", "matplotlib.pyplot")
PACKAGES = ("numpy",)
FILE = "PathPlanning/FrenetOptimalTrajectory/frenet_optimal_trajectory.py"


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Candidates of one plan on a straight lane, with the cars parked at the corridor as points to keep away from.

    options: folder: of the checkout
    """
    import importlib.util
    from pathlib import Path

    import numpy as np

    spec = importlib.util.spec_from_file_location("frenet_optimal_trajectory", Path(options["folder"]) / FILE)
    assert spec is not None
    assert spec.loader is not None
    planner: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(planner)
    planner.DT, planner.MIN_T, planner.MAX_T = 0.2, 4.8, 5.9  # 6 durations, up to 5.8 s
    planner.MAX_ROAD_WIDTH, planner.D_ROAD_W = 1.8, 0.2  # 18 offsets
    planner.TARGET_SPEED, planner.D_T_S, planner.N_S_SAMPLE = 6.0, 1.0, 1  # 2 speeds
    *_, line = planner.generate_target_course(list(np.linspace(-60.0, 60.0, 13)), [-1.75] * 13)
    parked = np.array([[x, y] for x in (-4.2, 0.0, 4.2) for y in (2.55, -2.55)])

    def plan() -> int:
        _, by_fate = planner.frenet_optimal_planning(line, 40.0, 4.8, 0.0, 0.0, 0.0, 0.0, parked)
        return sum(map(len, by_fate.values()))

    return plan, {"n_candidates": plan(), "n_times": 30}
