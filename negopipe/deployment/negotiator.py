"""The runtime: messages of a vehicle in, a trajectory out, from an export's folder; NumPy and onnxruntime alone.

What it does about inputs that are not as they should be:

| input | what is done | in `Diagnostics` |
|---|---|---|
| messages of any rate from 2 to 20 Hz | interpolated to the exported rate | |
| message that comes late, or out of order | put in its place in the past | `messages["late"]` |
| message that comes twice (same id and time) | the first one counts | `messages["duplicate"]` |
| message older than the past that is remembered | left out | `messages["old"]` |
| message ahead of the clock by more than `future_s` | left out | `messages["future"]` |
| message with NaN, or without a size | left out | `messages["invalid"]` |
| messages of an object lost for up to `gap_s` | it is carried on with its speed and heading | `carried_on` |
| messages of an object lost for longer | it is not seen any more, until it is | `lost` |
| an id that is not known | a new road user; its past is what `Settings.before` says, in the first decision standing | |
| object more than `jump_m` from where it is expected | another road user: past forgotten | `messages["jumped"]` |
| more objects than the export's capacity | the nearest ones count | `left_out` |
| no word of the objects (None) for more than `gap_s` | stop | `stop` = "objects" |
| ego more than `jump_m` from where it is expected | the past is forgotten, a new plan from there | `is_restarted` |
| ego more than `replan_m` from its last plan | a new plan from where it is, else from the last plan | `start` |
| state of the ego missing, with NaN, ahead of the clock, or older than `gap_s` | stop | `stop` = "ego_state" |
| ego more than `aside_m` from the street's line | stop | `stop` = "off_street" |
| clock that goes backwards | stop, and the past is forgotten | `stop` = "clock" |
| no decision for more than `gap_s` | the past plan is forgotten, a new plan from where the ego is | `is_restarted` |
| NaN in a decision | stop | `stop` = "decision" |
| a stop before there was any plan or valid state of the ego | UserError | |
| export of another version, damaged file, street beyond the capacity or without a corridor | UserError | |

A stop is full braking along the last plan, or straight on without one. The ego's state is carried on to the time of the
decision, too. Every result is made for the time at which it was asked for: an old plan is never returned.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from negopipe.deployment.draws import draw
from negopipe.deployment.history import ROUNDING_S, History, Pose
from negopipe.deployment.host_street import HostStreet, Surround, Tables, between_kerbs, host_street
from negopipe.deployment.manifest import STREET_NAME, read_manifest
from negopipe.deployment.messages import Array, Diagnostics, EgoState, ObjectState, Trajectory, is_finite
from negopipe.deployment.onnx_session import Graph
from negopipe.deployment.open_decision import Backend, Decide, open_decision
from negopipe.deployment.settings import Footprint, Settings
from negopipe.deployment.stop import stop_along
from negopipe.deployment.tracks import Tracks
from negopipe.errors import UserError
from negopipe.simulation.street import Street

STOPS = ("ego_state", "objects", "off_street", "clock", "decision")
"""Reasons of a stop."""

INTERVENTIONS = ("none", "last_plan", "planned_stop", "full_braking")
"""`safety.layer.INTERVENTIONS`, which needs torch."""

N_KEPT = 9
"""`safety.layer.N_KEPT`."""

AT_REST_MPS, UNCOUNTED_REST_S = 0.1, 1.0
"""`simulation.state.AT_REST_MPS`, `simulation.simulator.UNCOUNTED_REST_S`."""


class Start(NamedTuple):
    """Where a plan begins, in the host's frame.

    measured: [4], pose and speed of the ego now
    planned: [6], state from which the plan begins
    source: `Diagnostics.start`
    """

    measured: Pose
    planned: Array
    source: str


@dataclass(frozen=True)
class Memory:
    """What a decision leaves to the next one.

    time_s: of the decision
    plan: what is driven
    horizon_s: chosen, NaN after a stop
    kept: [1, N_KEPT], of the safety layer, in the frame of `street`; None with a stop
    passed_s: time of the last plan that it let pass
    """

    time_s: float
    plan: Trajectory
    horizon_s: float
    kept: Array
    street: HostStreet | None
    passed_s: float


class Negotiator:
    """The negotiator of one vehicle on one drive; it remembers what it saw and what it decided.

    settings: values of the export
    seed: of the numbers by which horizons are drawn, where the export draws them: decision n of a drive gets the number
        of decision n of the simulator's episode with that `noise_seed`
    """

    def __init__(self, settings: Settings, decide: Decide, surround: Surround, seed: int = 0) -> None:
        if seed < 0:
            raise UserError(f"seed must be a whole number from 0, got {seed}")
        self.settings, self._decide, self._surround, self._seed = settings, decide, surround, seed
        self._n_planned = 0
        self._times_s = settings.dt_s * np.arange(settings.n_times + 1)
        self._forget()
        self._memory: Memory | None = None

    @staticmethod
    def load(folder: Path | str, seed: int = 0, backend: Backend = "onnxruntime") -> "Negotiator":
        """The negotiator of an export's folder. UserError: no export with the file of the backend, or a damaged one.

        backend: onnxruntime runs decision.onnx, torch decision.pt2
        """
        folder = Path(folder)
        manifest = read_manifest(folder)
        decide = open_decision(folder, manifest, backend)
        has_street = STREET_NAME in manifest["files"]
        surround = Graph(folder / STREET_NAME) if has_street else _nothing_around
        return Negotiator(Settings.of(manifest["config"]), decide, surround, seed)

    def anew(self, length_m: float, width_m: float, seed: int) -> "Negotiator":
        """The negotiator of another drive, of a vehicle of that size; streets can be shared."""
        settings = replace(self.settings, ego=Footprint(length_m, width_m))
        return Negotiator(settings, self._decide, self._surround, seed)

    def street(self, street: Street, direction: float, origin: Array, heading: float) -> HostStreet:
        """A sampled street as the ego drives along it (+1) or against it (-1).

        origin: [2] m, middle of the corridor in the host's frame; heading: rad, of the line there
        """
        return host_street(street, direction, origin, heading, self.settings, self._surround)

    def street_between(self, left: Array, right: Array, parked: Array) -> HostStreet:
        """The street between two kerbs; `host_street.between_kerbs` says what the arguments are."""
        return between_kerbs(left, right, parked, self.settings, self._surround)

    def decide(
        self, ego: EgoState | None, objects: Iterable[ObjectState] | None, street: HostStreet, time_s: float
    ) -> Trajectory:
        """What to drive from now on.

        ego: newest state of the ego; None where there is none
        objects: messages since the last decision, in any order; an empty list says that nobody is seen, None that
            nothing was heard
        street: of this negotiator
        time_s: now
        """
        if not math.isfinite(time_s):
            raise UserError(f"time_s must be a finite number, got {time_s}")
        if self._memory is not None and time_s < self._memory.time_s:
            return self._stop_by_clock(ego, time_s)
        counted = self._hear(objects, time_s)
        start, is_restarted = self._where(ego, time_s)
        heard = Diagnostics(messages=counted, is_restarted=is_restarted)
        if start is None or ego is None:
            return self._stop(None, time_s, replace(heard, stop="ego_state"))
        if time_s - self._heard_s > self.settings.gap_s + ROUNDING_S:
            return self._stop(start, time_s, replace(heard, stop="objects"))
        if street.aside_m(street.to_street(np.array(start.measured))[:2]) > self.settings.aside_m:
            return self._stop(start, time_s, replace(heard, stop="off_street"))
        return self._plan(ego, start, street, time_s, heard)

    def _forget(self) -> None:
        """Forget the past of everyone."""
        settings = self.settings
        self._own = History(settings.keep_s, settings.gap_s)
        self._tracks = Tracks(settings)
        self._heard_s = -math.inf
        self._begin_s: float | None = None
        self._rest_from_s: float | None = None

    def _hear(self, objects: Iterable[ObjectState] | None, time_s: float) -> Counter[str]:
        """Take in the messages of the others."""
        if objects is None:
            if self._heard_s == -math.inf and self._begin_s is None:
                self._heard_s = time_s  # the first words may be on their way
            return Counter()
        is_first = self._begin_s is None
        self._heard_s = time_s
        return self._tracks.take(objects, time_s, is_first)

    def _where(self, ego: EgoState | None, time_s: float) -> tuple[Start | None, bool]:
        """Where the plan begins, None where that is not known; and whether the past is forgotten."""
        settings, is_restarted = self.settings, False
        if self._memory is not None and time_s - self._memory.time_s > settings.gap_s + ROUNDING_S:
            self._memory, is_restarted = None, True
        if ego is None or not is_finite(ego):
            return None, is_restarted
        if not -settings.future_s <= time_s - ego.time_s <= settings.gap_s + ROUNDING_S:
            return None, is_restarted
        pose = Pose(ego.x, ego.y, ego.yaw, ego.speed)
        expected = self._own.one(ego.time_s)
        if expected is not None and math.hypot(pose.x - expected.x, pose.y - expected.y) > settings.jump_m:
            self._own.clear()
            self._memory, is_restarted = None, True
        self._own.add(ego.time_s, pose)
        now = self._own.one(time_s, "stood") or pose
        measured = np.array([*now, ego.accel, ego.curvature])
        if self._memory is not None:
            planned = self._memory.plan.at(time_s)
            if math.hypot(now.x - planned[0], now.y - planned[1]) <= settings.replan_m:
                return Start(now, planned, "plan"), is_restarted
        return Start(now, measured, "measured"), is_restarted

    def _plan(self, ego: EgoState, start: Start, street: HostStreet, time_s: float, heard: Diagnostics) -> Trajectory:
        """Ask the exported decision."""
        settings, memory = self.settings, self._memory
        seen = self._tracks.at(time_s, (start.measured.x, start.measured.y))
        horizon_s = math.nan if memory is None else memory.horizon_s
        rest_s = self._rest(start.measured.speed, time_s)
        rest = (ego.desired_speed, horizon_s, rest_s, settings.ego.length_m, settings.ego.width_m)
        is_now, is_past = seen.is_seen[0, :, None] > 0, seen.is_seen[..., None] > 0
        arguments = {
            "own": np.concatenate([street.to_street(start.planned), rest]),
            "own_history": street.to_street(self._past(time_s)),
            "others": np.where(is_now, street.to_street(seen.others), 0.0),
            "others_history": np.where(is_past, street.to_street(seen.others_history), 0.0),
            "is_seen": seen.is_seen,
            "direction": np.array([street.direction]),
            "kept": self._kept(street, time_s),
            "draw": np.array([draw(self._seed, self._n_planned)]),
        }
        self._n_planned += 1
        found = self._decide({name: each.astype(np.float32) for name, each in arguments.items()} | dict(street.tables))
        said = replace(heard, carried_on=seen.carried_on, lost=seen.lost, left_out=seen.left_out, start=start.source)
        if settings.is_drawn:
            said = replace(said, draw=float(arguments["draw"][0]))
        if not np.isfinite(found["trajectory"]).all():
            return self._stop(start, time_s, replace(said, stop="decision"))
        return self._remember(found, start, street, time_s, said)

    def _remember(
        self, found: Mapping[str, Array], start: Start, street: HostStreet, time_s: float, said: Diagnostics
    ) -> Trajectory:
        intervention = int(found["intervention"][0]) if "intervention" in found else 0
        states = np.concatenate([start.planned[None], street.to_host(found["trajectory"])])
        horizon_s = float(found["horizon"][0])
        plan = Trajectory(
            time_s + self._times_s,
            states,
            horizon_s,
            bool(found["is_full_braking"][0]),
            replace(said, intervention=INTERVENTIONS[intervention], probabilities=self._probabilities(found["logits"])),
        )
        passed_s = time_s
        if intervention:
            passed_s = -math.inf if self._memory is None else self._memory.passed_s
        self._memory = Memory(time_s, plan, horizon_s, found.get("keep", _nothing_kept()), street, passed_s)
        if self._begin_s is None:
            self._begin_s = time_s
        return plan

    def _probabilities(self, logits: Array) -> dict[float, float]:
        """Of the horizons, by the policy's logits [1, A]."""
        shares = np.exp(logits[0] - logits[0].max())
        return dict(zip(self.settings.horizons_s, (shares / shares.sum()).tolist(), strict=True))

    def _past(self, time_s: float) -> Array:
        """[K, 3]: poses of the ego now and before; where messages are missing, the next known one."""
        settings = self.settings
        poses, known = self._own.at(time_s - settings.dt_s * np.arange(settings.n_past), "stood")
        newest_known = np.maximum.accumulate(np.where(known, np.arange(settings.n_past), 0))
        return poses[newest_known, :3]

    def _kept(self, street: HostStreet, time_s: float) -> Array:
        """[1, N_KEPT]: what the safety layer kept, its age in control steps at the last of them."""
        if self._memory is None or self._memory.street is not street:
            return _nothing_kept()
        kept = self._memory.kept.copy()
        kept[:, -1] = (time_s - self._memory.passed_s) / self.settings.dt_s - 1
        return kept

    def _rest(self, speed: float, time_s: float) -> float:
        """Time for which the ego has been at rest, s; the first second of a drive does not count."""
        dt_s = self.settings.dt_s
        begin_s = time_s if self._begin_s is None else self._begin_s
        if abs(speed) >= AT_REST_MPS or time_s - begin_s <= UNCOUNTED_REST_S + dt_s / 2:
            self._rest_from_s = None
            return 0.0
        if self._rest_from_s is None:
            self._rest_from_s = time_s - dt_s
        return time_s - self._rest_from_s

    def _stop_by_clock(self, ego: EgoState | None, time_s: float) -> Trajectory:
        """A stop by the new clock along the last plan, from where it would be one step later by the old one."""
        memory = self._memory
        assert memory is not None
        self._forget()
        moved = replace(memory.plan, times_s=memory.plan.times_s - memory.time_s - self.settings.dt_s + time_s)
        self._memory = replace(memory, plan=moved)
        return self._stop(None, time_s, Diagnostics(is_restarted=True, stop="clock"))

    def _stop(self, start: Start | None, time_s: float, said: Diagnostics) -> Trajectory:
        """Full braking along the last plan, or straight on from where the ego is."""
        memory = self._memory
        if memory is not None:
            plan = memory.plan
            path = np.concatenate([plan.at(time_s)[None], plan.states[plan.times_s > time_s]])
        elif start is not None:
            path = start.planned[None]
        elif len(self._own):
            last = self._own.newest
            path = np.array([[*last, 0.0, 0.0]])
        else:
            raise UserError(f"ego must be a finite state of at most {self.settings.gap_s} s ago in the first decision")
        states = stop_along(path, self._times_s, self.settings.full_braking_mps2)
        trajectory = Trajectory(time_s + self._times_s, states, math.nan, True, said)
        self._memory = Memory(time_s, trajectory, math.nan, _nothing_kept(), None, -math.inf)
        return trajectory


def _nothing_kept() -> Array:
    return np.full((1, N_KEPT), np.nan, dtype=np.float32)


def _nothing_around(tables: Tables) -> Tables:
    """For exports whose decision reads no places to wait."""
    return {}
