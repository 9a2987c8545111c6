"""How failed episodes came about, in a few words each: who met whom where, and who of them was driving."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from negopipe.evaluation.safety import agents, box_distance, footprints
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.simulation.state import EGO

DRIVING_MPS = 0.3
"""Speed from which a vehicle counts as driving, m/s."""
FOLLOWED_M = 15.0
"""Distance between the middles of two vehicles up to which one is close behind the other, m."""


class Failure(NamedTuple):
    """A failed episode.

    episode: its number
    outcome: one of `OUTCOMES`
    cause: how it came about, e.g. "the ego drove into an oncoming vehicle at rest"
    """

    episode: int
    outcome: str
    cause: str


def failures(trace: Trace) -> list[Failure]:
    """The failed episodes of a planner, in the order of their numbers."""
    at_end = _last_states(trace)
    gap_m = box_distance(*(agents(footprints(at_end), *of) for of in ((EGO, EGO + 1), (EGO + 1, None))))[-1].numpy()
    return [
        Failure(int(episode), OUTCOMES[trace.outcome[episode]], _cause(trace, int(episode), gap_m[episode]))
        for episode in np.flatnonzero(trace.outcome != OUTCOMES.index("success"))
    ]


def _last_states(trace: Trace) -> Trace:
    """The trace without all but its last state; rows after an episode's end repeat that."""
    states = ("position_m", "yaw_rad", "speed_mps", "progress_m")
    return replace(trace, **{name: getattr(trace, name)[-1:] for name in states})


def _cause(trace: Trace, episode: int, gap_m: np.ndarray) -> str:
    """gap_m: [V-1] from the ego to each other vehicle at the end of the episode."""
    outcome = OUTCOMES[trace.outcome[episode]]
    if outcome == "collision":
        return _contact(trace, episode, gap_m)
    if outcome == "social_collision":
        return "two others collided"
    if outcome == "deadlock":
        return "nose to nose at rest" + (", a vehicle close behind the ego" if _is_followed(trace, episode) else "")
    if trace.reached_step[episode, EGO] >= 0:
        return "the ego arrived, another vehicle did not"
    return f"the ego {_doing(trace, episode, EGO)} {_place(trace, episode)}"


def _contact(trace: Trace, episode: int, gap_m: np.ndarray) -> str:
    if gap_m.min() > 0:
        return "touched a kerb or a parked car"
    other = EGO + 1 + int(gap_m.argmin())
    end = trace.n_steps[episode]
    yaw = trace.yaw_rad[end, episode]
    is_oncoming = np.cos(yaw[other] - yaw[EGO]) < 0
    is_behind = trace.progress_m[end, episode, other] < trace.progress_m[end, episode, EGO]
    name = "an oncoming vehicle" if is_oncoming else "a vehicle behind" if is_behind else "a vehicle ahead"
    ego_drives, other_drives = (_doing(trace, episode, vehicle) == "drove" for vehicle in (EGO, other))
    if ego_drives and other_drives:
        if _backs_away(trace, episode, other):
            return f"{name} drove into the ego as it drove back"
        return f"the ego and {name} drove into each other"
    if ego_drives:
        return f"the ego drove into {name} at rest"
    return f"{name} drove into the ego at rest" if other_drives else f"the ego and {name} touched at rest"


def _backs_away(trace: Trace, episode: int, other: int) -> bool:
    """Whether the ego drove backwards, away from the other vehicle in front of it."""
    before = max(0, trace.n_steps[episode] - 1)
    yaw = trace.yaw_rad[before, episode, EGO]
    to_other = trace.position_m[before, episode, other] - trace.position_m[before, episode, EGO]
    is_in_front = np.cos(yaw) * to_other[0] + np.sin(yaw) * to_other[1] > 0
    return bool(is_in_front and trace.speed_mps[before, episode, EGO] < 0)


def _is_followed(trace: Trace, episode: int) -> bool:
    """Whether a vehicle that drives the same way is so close behind the ego that it has no way back."""
    end = trace.n_steps[episode]
    yaw, s = trace.yaw_rad[end, episode], trace.progress_m[end, episode]
    behind_m = s[EGO] - s[EGO + 1 :]
    return bool(((np.cos(yaw[EGO + 1 :] - yaw[EGO]) > 0) & (behind_m > 0) & (behind_m < FOLLOWED_M)).any())


def _doing(trace: Trace, episode: int, vehicle: int) -> str:
    """Whether a vehicle drove or stood one step before the end, when a collision had not stopped it yet."""
    before = max(0, trace.n_steps[episode] - 1)
    return "drove" if abs(trace.speed_mps[before, episode, vehicle]) >= DRIVING_MPS else "stood"


def _place(trace: Trace, episode: int) -> str:
    """Where the ego is at the end, by the corridor; its length is that between the mouths."""
    s = trace.progress_m[trace.n_steps[episode], episode, EGO]
    if s < 0:
        return "before the corridor"
    return "in the corridor" if s < trace.corridor_m[episode] else "behind the corridor"
