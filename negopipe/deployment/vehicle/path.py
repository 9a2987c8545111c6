"""A trajectory for a controller: where the car is to be at a time, and the path abreast of where it is."""

from typing import NamedTuple

import numpy as np

from negopipe.deployment.history import wrapped
from negopipe.deployment.messages import Trajectory


class Reference(NamedTuple):
    """A state of a plan: m, m, rad (continuous, not wrapped), m/s, m/s2, 1/m."""

    x: float
    y: float
    yaw: float
    speed: float
    accel: float
    curvature: float


class Abreast(NamedTuple):
    """The place of a path abreast of a car.

    along_m: way along the path from its start; left_m: distance of the car to the left of the path
    yaw: rad, of the plan there
    """

    along_m: float
    left_m: float
    yaw: float


class Path:
    """A trajectory as a polyline in time and in space."""

    def __init__(self, plan: Trajectory) -> None:
        self._times_s, self._states = plan.times_s, plan.states.copy()
        self._states[:, 2] = np.unwrap(self._states[:, 2])
        self._points, self._yaw = self._states[:, :2], self._states[:, 2]
        steps = np.diff(self._points, axis=0)
        lengths = np.hypot(*steps.T)
        self._along_m = np.concatenate([[0.0], np.cumsum(lengths)])
        self._steps, self._lengths = steps, lengths
        self._squared = np.maximum(lengths**2, 1e-9)

    def at(self, time_s: float) -> Reference:
        """The plan at a time; its nearest end outside."""
        step_s = self._times_s[1] - self._times_s[0]
        place = min(max((time_s - self._times_s[0]) / step_s, 0.0), len(self._times_s) - 1.0)
        index = min(int(place), len(self._times_s) - 2)
        share = place - index
        return Reference(*((1 - share) * self._states[index] + share * self._states[index + 1]).tolist())

    def abreast(self, x: float, y: float) -> Abreast:
        """The nearest place of the path; it goes straight on at its ends."""
        away = np.array([x, y]) - self._points[:-1]
        shares = (away * self._steps).sum(1) / self._squared
        clipped = shares.clip(0.0, 1.0)
        index = int(np.argmin(((away - clipped[:, None] * self._steps) ** 2).sum(1)))
        share = float(shares[index])
        inside = min(max(share, 0.0), 1.0)
        yaw = float((1 - inside) * self._yaw[index] + inside * self._yaw[index + 1])
        foot = self._points[index] + inside * self._steps[index]
        left_m = float((y - foot[1]) * np.cos(yaw) - (x - foot[0]) * np.sin(yaw))
        return Abreast(float(self._along_m[index] + share * self._lengths[index]), left_m, yaw)

    def curvature(self, along_m: float) -> float:
        """Curvature at a way along the path, 1/m; that of the nearest end outside."""
        return float(np.interp(along_m, self._along_m, self._states[:, 5]))


def error(reference: Reference, x: float, y: float, yaw: float) -> tuple[float, float, float]:
    """How far a car is ahead of a state of its plan (m), to the left of it (m), and turned to the left of it (rad)."""
    dx, dy = x - reference.x, y - reference.y
    cos, sin = np.cos(reference.yaw), np.sin(reference.yaw)
    return float(dx * cos + dy * sin), float(dy * cos - dx * sin), wrapped(yaw - reference.yaw)
