"""commonroad-reactive-planner on the same street: two lanes, cars parked at a corridor, an oncoming car."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("commonroad_rp.reactive_planner", "commonroad_rp.utility.config")
PACKAGES = ("commonroad-reactive-planner", "commonroad-io", "commonroad-drivability-checker", "numpy")

DT_S, N_TIMES = 0.2, 30


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Candidates of one plan; collisions are checked from the cheapest candidate on, until one is free."""
    import logging

    import numpy as np
    from commonroad_rp.reactive_planner import ReactivePlanner
    from commonroad_rp.state import ReactivePlannerState
    from commonroad_rp.utility.config import ReactivePlannerConfiguration
    from commonroad_rp.utility.utils_coordinate_system import create_coordinate_system

    config = ReactivePlannerConfiguration()
    config.planning.dt, config.planning.time_steps_computation = DT_S, N_TIMES
    config.debug.multiproc, config.debug.logging_level = False, logging.ERROR
    config.sampling.t_min, config.sampling.d_min, config.sampling.d_max = 3.6, -0.8, 1.75  # 7 durations
    config.sampling.vel_init_samples = config.sampling.pos_init_samples = 3
    config.update(scenario=_street())
    planner = ReactivePlanner(config)
    lane = create_coordinate_system(np.column_stack([np.linspace(-60.0, 60.0, 241), np.full(241, -1.75)]))
    rear = np.array([-20.0 - config.vehicle.wb_rear_axle, -1.75])
    now = {"position": rear, "orientation": 0.0, "velocity": 4.8, "acceleration": 0.0}
    state = ReactivePlannerState(time_step=0, steering_angle=0.0, yaw_rate=0.0, **now)
    checker = planner.collision_checker

    def plan() -> int:
        planner.reset(initial_state_cart=state, collision_checker=checker, coordinate_system=lane)
        planner.set_desired_velocity(desired_velocity=6.0, current_speed=4.8)
        assert planner.plan(current_sampling_level=1) is not None
        return planner.total_count_samples

    return plan, {"n_candidates": plan(), "n_times": N_TIMES}


def _street() -> Any:
    import numpy as np
    from commonroad.geometry.shape import Rectangle
    from commonroad.prediction.prediction import TrajectoryPrediction
    from commonroad.scenario.lanelet import Lanelet
    from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType, StaticObstacle
    from commonroad.scenario.scenario import Scenario
    from commonroad.scenario.state import CustomState, InitialState
    from commonroad.scenario.trajectory import Trajectory

    street, x = Scenario(dt=DT_S), np.linspace(-60.0, 60.0, 121)
    right, middle, left = (np.column_stack([x, np.full_like(x, y)]) for y in (-3.5, 0.0, 3.5))
    street.add_objects(Lanelet(middle, (right + middle) / 2, right, 1))
    street.add_objects(Lanelet(middle[::-1], ((left + middle) / 2)[::-1], left[::-1], 2))

    def at(x_m: float, y_m: float, yaw: float, speed: float, step: int) -> dict[str, Any]:
        return {"position": np.array([x_m, y_m]), "orientation": yaw, "velocity": speed, "time_step": step}

    still = {"acceleration": 0.0, "yaw_rate": 0.0, "slip_angle": 0.0}
    places = [(x_m, y_m) for x_m in (-4.2, 0.0, 4.2) for y_m in (2.55, -2.55)]
    for number, (x_m, y_m) in enumerate(places):
        state = InitialState(**at(x_m, y_m, 0.0, 0.0, 0), **still)
        street.add_objects(StaticObstacle(10 + number, ObstacleType.PARKED_VEHICLE, Rectangle(3.6, 1.9), state))
    path = [CustomState(**at(22.0 - 5.0 * DT_S * step, 1.75, np.pi, 5.0, step)) for step in range(1, N_TIMES + 1)]
    size = Rectangle(4.5, 1.8)
    other = InitialState(**at(22.0, 1.75, np.pi, 5.0, 0), **still)
    prediction = TrajectoryPrediction(Trajectory(1, path), size)
    street.add_objects(DynamicObstacle(20, ObstacleType.CAR, size, other, prediction))
    return street
