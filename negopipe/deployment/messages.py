"""What a host gives to the runtime and gets from it; NumPy alone.

Poses are those of the middle of the footprint in the host's own fixed frame, such as that of its map: x, y in m, yaw in
rad. Times are those of the host's clock, s.
"""

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

Array = np.ndarray


class EgoState(NamedTuple):
    """The vehicle itself at a time.

    speed: m/s, negative backwards; accel: m/s2, along the path; curvature: 1/m of the path, positive to the left
    desired_speed: m/s
    """

    time_s: float
    x: float
    y: float
    yaw: float
    speed: float
    accel: float
    curvature: float
    desired_speed: float


class ObjectState(NamedTuple):
    """Another road user at a time; id: the same in all messages of one road user; length, width: m."""

    id: Hashable
    time_s: float
    x: float
    y: float
    yaw: float
    speed: float
    length: float
    width: float


def is_finite(message: EgoState | ObjectState) -> bool:
    """Whether no number of a message is NaN or infinite."""
    return all(math.isfinite(value) for name, value in message._asdict().items() if name != "id")


@dataclass(frozen=True)
class Diagnostics:
    """What the runtime did about its inputs in one decision.

    messages: number of messages of objects by what was done about them, the words of `tracks.WORDS`
    carried_on: ids of objects whose last message is older than a control step: their place is predicted
    lost: ids of objects that were seen and whose last message is too old
    left_out: ids of the farthest objects, beyond the capacity of the export
    start: what the plan begins at: `plan`, the last plan; `measured`, the state of the ego
    is_restarted: the past was forgotten
    intervention: of the safety layer, `none` where it drove the plan as it is or where the export has no layer
    stop: why the vehicle is stopped, one of `negotiator.STOPS`; empty where it is not
    probabilities: of the policy, by horizon in s; empty for a stop
    draw: uniform number by which the horizon was drawn; NaN for a stop, and where the most probable one is taken
    """

    messages: Mapping[str, int] = field(default_factory=dict)
    carried_on: tuple[Hashable, ...] = ()
    lost: tuple[Hashable, ...] = ()
    left_out: tuple[Hashable, ...] = ()
    start: str = "measured"
    is_restarted: bool = False
    intervention: str = "none"
    stop: str = ""
    probabilities: Mapping[float, float] = field(default_factory=dict)
    draw: float = math.nan


@dataclass(frozen=True)
class Trajectory:
    """What the vehicle is to drive until the next decision, and where that goes.

    times_s: [T + 1], from the time of the decision on
    states: [T + 1, 6], x, y (m), yaw (rad), speed (m/s), acceleration (m/s2), curvature (1/m), in the host's frame
    horizon_s: prediction horizon that the policy chose, NaN for a stop
    is_full_braking: no plan was feasible
    """

    times_s: Array
    states: Array
    horizon_s: float
    is_full_braking: bool
    diagnostics: Diagnostics

    def at(self, time_s: float) -> Array:
        """[6]: state at a time, interpolated; that of the nearest end outside."""
        yaw = np.unwrap(self.states[:, 2])
        columns = [yaw if column == 2 else self.states[:, column] for column in range(6)]
        return np.array([np.interp(time_s, self.times_s, column) for column in columns])
