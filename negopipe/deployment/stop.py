"""A stop without a decision: full braking on along the path of the last plan; NumPy alone."""

import numpy as np

from negopipe.deployment.messages import Array

FAR_M = 100.0
"""Length by which a path goes straight on behind its end, m."""


def stop_along(path: Array, times_s: Array, decel_mps2: float) -> Array:
    """States [T, 6] of full braking along a path; the first is the path's start.

    path: [P, 6], states (x, y, yaw, speed, acceleration, curvature) from the present one on, of which only the first
        speed counts
    times_s: [T], from 0 on
    """
    points = path[:, :2]
    gear = -1.0 if path[0, 3] < 0 else 1.0
    heading = np.array([np.cos(path[-1, 2]), np.sin(path[-1, 2])])
    points = np.concatenate([points, points[-1:] + gear * FAR_M * heading])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    yaw, curvature = np.append(np.unwrap(path[:, 2]), 0.0), np.append(path[:, 5], 0.0)
    yaw[-1] = yaw[-2]
    speed = abs(path[0, 3])
    moving_s = np.minimum(times_s, speed / decel_mps2)
    travelled = speed * moving_s - decel_mps2 * moving_s**2 / 2
    left = np.maximum(speed - decel_mps2 * times_s, 0.0)
    x, y, turned, bent = (np.interp(travelled, along, each) for each in (*points.T, yaw, curvature))
    return np.stack([x, y, turned, gear * left, np.where(left > 0, -gear * decel_mps2, 0.0), bent], axis=-1)
