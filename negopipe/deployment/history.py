"""The past of a vehicle or an object: messages at any rate in, states at the exported rate out; NumPy alone."""

from bisect import bisect_left
from typing import NamedTuple

import numpy as np

Array = np.ndarray

ROUNDING_S = 1e-6
"""Difference of two times that are the same, s."""


class Pose(NamedTuple):
    """A message's content: place of the footprint's middle (m), heading (rad) and speed (m/s), in one fixed frame."""

    x: float
    y: float
    yaw: float
    speed: float


class History:
    """Poses by time, ascending; a time is held once.

    keep_s: time that is remembered
    gap_s: longest time between two messages over which the pose between them, or after the last one, is known
    """

    def __init__(self, keep_s: float, gap_s: float) -> None:
        self._keep_s, self._gap_s = keep_s, gap_s
        self._times: list[float] = []
        self._poses: list[Pose] = []

    def __len__(self) -> int:
        return len(self._times)

    @property
    def newest_s(self) -> float:
        """Time of the newest message, -inf without one."""
        return self._times[-1] if self._times else -np.inf

    def add(self, time_s: float, pose: Pose) -> bool:
        """Take in a message, also one that comes late; whether it is new: its time is not held yet."""
        index = bisect_left(self._times, time_s)
        if index < len(self._times) and self._times[index] == time_s:
            return False
        self._times.insert(index, time_s)
        self._poses.insert(index, pose)
        first = bisect_left(self._times, self.newest_s - self._keep_s - self._gap_s)
        del self._times[:first], self._poses[:first]
        return True

    def at(self, times_s: Array) -> tuple[Array, Array]:
        """Poses [K, 4] at times [K] and where they are known [K] bool; 0 where not.

        Between two messages a pose is interpolated, the heading the short way round. After the last message the vehicle
        is carried on with its speed and heading, for `gap_s` at most. Before the first message nothing is known.
        """
        known = np.zeros(len(times_s), dtype=bool)
        poses = np.zeros((len(times_s), 4))
        for row, time_s in enumerate(times_s):
            found = self._one(float(time_s))
            if found is not None:
                known[row], poses[row] = True, found
        return poses, known

    def _one(self, time_s: float) -> Pose | None:
        after = bisect_left(self._times, time_s - ROUNDING_S)
        if after == len(self._times):
            return self._carried_on(time_s)
        if abs(self._times[after] - time_s) <= ROUNDING_S:
            return self._poses[after]
        if after == 0 or self._times[after] - self._times[after - 1] > self._gap_s:
            return None
        one, two = self._poses[after - 1], self._poses[after]
        share = (time_s - self._times[after - 1]) / (self._times[after] - self._times[after - 1])
        turn = (two.yaw - one.yaw + np.pi) % (2 * np.pi) - np.pi
        values = (a + share * (b - a) for a, b in zip(one, two._replace(yaw=one.yaw + turn), strict=True))
        return Pose(*values)

    def _carried_on(self, time_s: float) -> Pose | None:
        ahead_s = time_s - self.newest_s
        if ahead_s > self._gap_s + ROUNDING_S:
            return None
        last = self._poses[-1]
        driven = last.speed * ahead_s
        return last._replace(x=last.x + driven * np.cos(last.yaw), y=last.y + driven * np.sin(last.yaw))
