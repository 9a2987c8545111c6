"""Tracks of the other road users by their ids, from messages in any order; NumPy alone."""

import math
from collections import Counter
from collections.abc import Hashable, Iterable
from typing import NamedTuple

import numpy as np

from negopipe.deployment.history import Before, History, Pose
from negopipe.deployment.messages import Array, ObjectState, is_finite
from negopipe.deployment.settings import Settings

WORDS = ("new", "late", "duplicate", "old", "future", "invalid", "jumped")
"""What is done about a message: taken in; put in its place in the past; left out, because its time is there already,
is older than what is remembered, or is ahead of the clock, or because a number is NaN or infinite; taken for another
road user of the same id, whose past is forgotten."""


class Track:
    """The past of one road user.

    before: what is assumed of the time before its first message
    """

    def __init__(self, message: ObjectState, settings: Settings, is_first: bool) -> None:
        self.history = History(settings.keep_s, settings.gap_s)
        self.before: Before = "stood" if is_first else settings.before
        self.length, self.width = message.length, message.width

    def take(self, message: ObjectState, settings: Settings) -> str:
        """Take in a message; returns its word."""
        newest_s = self.history.newest_s
        word = "late" if message.time_s < newest_s else "new"
        if word == "new":
            self.length, self.width = message.length, message.width
            expected = self.history.one(message.time_s)
            if expected is not None and self._is_elsewhere(message, expected, settings):
                self.history.clear()
                self.before, word = settings.before, "jumped"
        pose = Pose(message.x, message.y, message.yaw, message.speed)
        return word if self.history.add(message.time_s, pose) else "duplicate"

    @staticmethod
    def _is_elsewhere(message: ObjectState, expected: Pose, settings: Settings) -> bool:
        return math.hypot(message.x - expected.x, message.y - expected.y) > settings.jump_m


class Seen(NamedTuple):
    """The others at the times of a decision: arguments of the exported decision, in the host's frame, float64.

    others: [N, 7], x, y, yaw, speed, acceleration, length, width; others_history: [K, N, 3]; is_seen: [K, N]
    carried_on, lost, left_out: ids, as in `Diagnostics`
    """

    others: Array
    others_history: Array
    is_seen: Array
    carried_on: tuple[Hashable, ...]
    lost: tuple[Hashable, ...]
    left_out: tuple[Hashable, ...]


class Tracks:
    """All road users that are remembered."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._tracks: dict[Hashable, Track] = {}

    def take(self, messages: Iterable[ObjectState], now_s: float, is_first: bool) -> Counter[str]:
        """Take in messages in any order; returns their number by `WORDS`. is_first: in the first decision."""
        done = Counter(self._take(message, now_s, is_first) for message in messages)
        oldest_s = now_s - self._settings.keep_s
        self._tracks = {key: track for key, track in self._tracks.items() if track.history.newest_s >= oldest_s}
        return done

    def _take(self, message: ObjectState, now_s: float, is_first: bool) -> str:
        settings = self._settings
        if not is_finite(message) or min(message.length, message.width) <= 0:
            return "invalid"
        if message.time_s > now_s + settings.future_s:
            return "future"
        if message.time_s < now_s - settings.keep_s:
            return "old"
        if message.id not in self._tracks:
            self._tracks[message.id] = Track(message, settings, is_first)
        return self._tracks[message.id].take(message, settings)

    def at(self, now_s: float, own_xy: tuple[float, float]) -> Seen:
        """The others now and at the steps before; own_xy: place of the ego, of more than fit the nearest are kept."""
        settings = self._settings
        times_s = np.append(now_s - settings.dt_s * np.arange(settings.n_past), now_s - settings.accel_window_s)
        n = settings.n_others
        others, past = np.zeros((n, 7)), np.zeros((settings.n_past, n, 3))
        is_seen = np.zeros((settings.n_past, n))
        found = {key: track.history.at(times_s, track.before) for key, track in self._tracks.items()}
        present = [key for key, (_, known) in found.items() if known[0]]
        kept = present
        if len(present) > n:
            kept = sorted(present, key=lambda key: math.dist(found[key][0][0, :2], own_xy))[:n]
        for row, key in enumerate(kept):
            (poses, known), track = found[key], self._tracks[key]
            accel = (poses[0, 3] - poses[-1, 3]) / settings.accel_window_s if known[-1] else 0.0
            others[row] = (*poses[0], accel, track.length, track.width)
            past[:, row], is_seen[:, row] = poses[:-1, :3], known[:-1]
        is_old = now_s - settings.dt_s * 1.01
        return Seen(
            others,
            past,
            is_seen,
            carried_on=tuple(key for key in kept if self._tracks[key].history.newest_s < is_old),
            lost=tuple(key for key in found if key not in present),
            left_out=tuple(key for key in present if key not in kept),
        )
