"""The past of a vehicle or an object: messages at any rate in, states at the exported rate out; NumPy alone."""

import math
from bisect import bisect_left
from typing import Literal, NamedTuple

import numpy as np

Array = np.ndarray

Before = Literal["unknown", "stood", "driven"]
"""What holds before the first message: nothing is known; the vehicle stood there, as at the start of an episode in
training; it came there with its speed and heading."""

ROUNDING_S = 1e-6
"""Difference of two times that are the same, s."""


class Pose(NamedTuple):
    """A message's content: place of the footprint's middle (m), heading (rad) and speed (m/s), in one fixed frame."""

    x: float
    y: float
    yaw: float
    speed: float


def wrapped(angle: float) -> float:
    """An angle in [-pi, pi), rad."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


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
        return self._times[-1] if self._times else -math.inf

    @property
    def newest(self) -> Pose:
        """Pose of the newest message, of which there is one."""
        return self._poses[-1]

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

    def clear(self) -> None:
        """Forget all messages."""
        self._times.clear()
        self._poses.clear()

    def at(self, times_s: Array, before: Before) -> tuple[Array, Array]:
        """Poses [K, 4] at times [K] and where they are known [K] bool; 0 where not.

        Between two messages a pose is interpolated, the heading the short way round. After the last message the vehicle
        is carried on with its speed and heading, for `gap_s` at most. Before the first message `before` holds.
        """
        known = np.zeros(len(times_s), dtype=bool)
        poses = np.zeros((len(times_s), 4))
        for row, time_s in enumerate(times_s):
            found = self.one(float(time_s), before)
            if found is not None:
                known[row], poses[row] = True, found
        return poses, known

    def one(self, time_s: float, before: Before = "unknown") -> Pose | None:
        """Pose at a time as `at` gives it, None where it is not known."""
        if self._times and time_s < self._times[0] - ROUNDING_S:
            return self._earlier(time_s, before)
        after = bisect_left(self._times, time_s - ROUNDING_S)
        if after == len(self._times):
            return self._carried_on(time_s)
        if abs(self._times[after] - time_s) <= ROUNDING_S:
            return self._poses[after]
        if self._times[after] - self._times[after - 1] > self._gap_s:
            return None
        one, two = self._poses[after - 1], self._poses[after]
        share = (time_s - self._times[after - 1]) / (self._times[after] - self._times[after - 1])
        turned = two._replace(yaw=one.yaw + wrapped(two.yaw - one.yaw))
        x, y, yaw, speed = (a + share * (b - a) for a, b in zip(one, turned, strict=True))
        return Pose(x, y, wrapped(yaw), speed)

    def _carried_on(self, time_s: float) -> Pose | None:
        ahead_s = time_s - self.newest_s
        if ahead_s > self._gap_s + ROUNDING_S:
            return None
        return _moved(self._poses[-1], ahead_s)

    def _earlier(self, time_s: float, before: Before) -> Pose | None:
        match before:
            case "unknown":
                return None
            case "stood":
                return self._poses[0]
            case "driven":
                return _moved(self._poses[0], time_s - self._times[0])


def _moved(pose: Pose, seconds: float) -> Pose:
    """The pose some seconds later, or earlier, with its speed and heading."""
    driven = pose.speed * seconds
    return pose._replace(x=pose.x + driven * math.cos(pose.yaw), y=pose.y + driven * math.sin(pose.yaw))
