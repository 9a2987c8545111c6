"""A drive placed by hand: one episode of vehicles in a line along x, without a simulator."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from negopipe.evaluation.trace import OUTCOMES, Trace


def in_a_line(x: np.ndarray, yaw: Sequence[float], **fields: object) -> Trace:
    """Vehicles at `x` [T+1, V] (m) with a yaw each, which stand and do not get anywhere; `fields` are other than that.

    The first is the ego. All are 4 m long and 2 m wide.
    """
    x = np.float32(x)[:, None]
    n, _, n_vehicles = x.shape
    facing = np.broadcast_to(np.float32(yaw), x.shape).copy()
    trace = Trace(
        planner="adaptive",
        setting="push",
        dt_s=0.2,
        street=np.ones(1, dtype=np.int64),
        corridor_m=np.full(1, 12.0, dtype=np.float32),
        start_distance_m=np.zeros((1, n_vehicles)),
        style_horizon_s=np.zeros((1, n_vehicles)),
        length_m=np.full((1, n_vehicles), 4.0, dtype=np.float32),
        width_m=np.full((1, n_vehicles), 2.0, dtype=np.float32),
        driver=np.full((1, n_vehicles), "planner"),
        position_m=np.stack([x, np.zeros_like(x)], -1),
        yaw_rad=facing,
        speed_mps=np.zeros_like(x),
        progress_m=x * np.cos(facing),
        horizon_s=np.zeros((n - 1, 1, n_vehicles)),
        is_full_braking=np.zeros((n - 1, 1, n_vehicles), dtype=bool),
        intervention=np.zeros((n - 1, 1), dtype=np.int8),
        reward=np.zeros((n - 1, 1)),
        n_steps=np.array([n - 1]),
        reached_step=np.full((1, n_vehicles), -1),
        outcome=np.array([OUTCOMES.index("timeout")]),
    )
    return replace(trace, **fields)


def drive(outcome: str, x: Sequence[float], speed: Sequence[float], yaw: Sequence[float], **fields: object) -> Trace:
    """Vehicles that come to rest at `x` in the last of three states."""
    speeds = np.float32([speed, speed, [0.0] * len(x)])[:, None]
    return in_a_line(np.tile(x, (3, 1)), yaw, speed_mps=speeds, outcome=np.array([OUTCOMES.index(outcome)]), **fields)
