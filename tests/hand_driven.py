"""A drive placed by hand: one episode of vehicles in a line, without a simulator."""

from dataclasses import replace

import numpy as np

from negopipe.evaluation.trace import OUTCOMES, Trace

LENGTH_M = 4.0


def drive(
    outcome: str, x: tuple[float, ...], speed: tuple[float, ...], yaw: tuple[float, ...], **fields: object
) -> Trace:
    """One episode of vehicles in a line; the ego is the first. They come to rest in the last of three states."""
    n = len(x)
    speeds = np.float32([speed, speed, [0.0] * n])[:, None]
    places = np.tile(np.float32(x), (3, 1, 1))
    trace = Trace(
        planner="adaptive",
        setting="mixture",
        dt_s=0.2,
        street=np.ones(1, dtype=np.int64),
        corridor_m=np.full(1, 12.0, dtype=np.float32),
        start_distance_m=np.zeros((1, n)),
        style_horizon_s=np.zeros((1, n)),
        length_m=np.full((1, n), LENGTH_M, dtype=np.float32),
        width_m=np.full((1, n), 2.0, dtype=np.float32),
        driver=np.full((1, n), "planner"),
        position_m=np.stack([places, np.zeros_like(places)], -1),
        yaw_rad=np.tile(np.float32(yaw), (3, 1, 1)),
        speed_mps=speeds,
        progress_m=places * np.cos(np.float32(yaw)),
        horizon_s=np.zeros((2, 1, n)),
        is_full_braking=np.zeros((2, 1, n), dtype=bool),
        intervention=np.zeros((2, 1), dtype=np.int8),
        reward=np.zeros((2, 1)),
        n_steps=np.array([2]),
        reached_step=np.full((1, n), -1),
        outcome=np.array([OUTCOMES.index(outcome)]),
    )
    return replace(trace, **fields)
