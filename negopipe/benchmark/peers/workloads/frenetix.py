"""frenetix: the C++ core of the Frenetix motion planner, on the same street and with as many candidates.

Its Python planner adds a collision check of the cheapest trajectories. That needs the CommonRoad packages beside it and
is left out here.
"""

import itertools
from collections.abc import Callable
from typing import Any

LIBRARIES = ("numpy", "frenetix", "frenetix.trajectory_functions")
PACKAGES = ("frenetix", "numpy")

DT_S, HORIZON_S = 0.2, 6.0
CAR = {"length": 4.508, "width": 1.61, "wheelbase": 2.579, "to_rear_m": 1.42}
"""BMW 320i of the CommonRoad vehicle models, which frenetix is used with."""


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Candidates of one plan: sampled, checked for kinematic limits, costs, sorted, the best feasible one chosen.

    options: with_other: the probability of touching the oncoming car is part of the cost
    """
    import frenetix
    import numpy as np

    path = np.column_stack([np.linspace(-60.0, 60.0, 241), np.full(241, -1.75)])
    line = frenetix.CoordinateSystemWrapper(path)
    now = frenetix.CartesianPlannerState(np.array([-20.0, -1.75]), 0.0, 4.8, 0.0, 0.0)
    durations, speeds, offsets = np.linspace(1.0, HORIZON_S, 6), np.linspace(0.0, 7.0, 6), np.linspace(-0.8, 1.75, 6)

    def plan() -> int:
        at = frenetix.compute_initial_state(
            coordinate_system=line, x_0=now, wheelbase=CAR["wheelbase"], low_velocity_mode=False
        )
        handler = frenetix.TrajectoryHandler(dt=DT_S)
        _add_functions(handler, line, options["with_other"])
        samples = itertools.product(durations, speeds, offsets)
        rows = [(0.0, t, *at.x0_lon, v, 0.0, *at.x0_lat, d, 0.0, 0.0) for t, v, d in samples]
        handler.generate_trajectories(np.array(rows), False)
        handler.evaluate_all_current_functions(True)
        best = next(each for each in handler.get_sorted_trajectories() if each.feasible)
        assert len(best.cartesian.x) > HORIZON_S / DT_S
        return len(rows)

    return plan, {"n_candidates": plan(), "n_times": round(HORIZON_S / DT_S)}


def _add_functions(handler: Any, line: Any, with_other: bool) -> None:
    """The checks of Frenetix's planner, and costs like ours."""
    from frenetix import trajectory_functions as functions

    checks, costs = functions.feasability_functions, functions.cost_functions
    limits = {"wheelbase": CAR["wheelbase"], "wholeTrajectory": False}
    handler.add_feasability_function(checks.CheckYawRateConstraint(deltaMax=1.066, **limits))
    handler.add_feasability_function(checks.CheckAccelerationConstraint(7.319, 11.5, False))
    handler.add_feasability_function(checks.CheckCurvatureConstraint(deltaMax=1.066, **limits))
    handler.add_feasability_function(checks.CheckCurvatureRateConstraint(velocityDeltaMax=0.4, **limits))
    handler.add_cost_function(costs.CalculateJerkCost("jerk", 0.1))
    handler.add_cost_function(costs.CalculateDistanceToReferencePathCost("offset", 0.5))
    handler.add_cost_function(costs.CalculateVelocityOffsetCost("speed", 1.0, 6.0, 0.1, 1.1, False, 2))
    if with_other:
        size = CAR["length"], CAR["width"], CAR["to_rear_m"]
        handler.add_cost_function(costs.CalculateCollisionProbabilityFast("other", 0.2, {1: _oncoming()}, *size))
    handler.add_function(functions.FillCoordinates(False, 0.0, line, HORIZON_S))


def _oncoming() -> Any:
    """An oncoming car at 5 m/s, with a standard deviation of 0.3 m."""
    import frenetix
    import numpy as np

    backwards, spread = np.array([0.0, 0.0, 1.0, 0.0]), np.diag([0.1, 0.1, 0.0, 0.0, 0.0, 0.0])
    path = [
        frenetix.PoseWithCovariance(np.array([22.0 - 5.0 * DT_S * step, 1.75, 0.0]), backwards, spread)
        for step in range(1, round(HORIZON_S / DT_S) + 1)
    ]
    return frenetix.PredictedObject(1, path, 4.5, 1.8)
