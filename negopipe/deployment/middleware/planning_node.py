"""The node without a transport: messages in, a decision when one is due, messages out.

The clock is that of the stamps. A decision is due when an odometry comes whose stamp is a period or more after the last
decision, and is made for the time of that stamp. What else came until then is taken in before. Lost, late, repeated and
reordered objects are the runtime's affair (`negotiator.py` has the table); the node itself does this:

| input | what is done | on the debug topic |
|---|---|---|
| message of another frame than `map` | left out | `left_out_frame` |
| odometry or acceleration that is older than the newest | left out | `left_out_old` |
| odometry more than `RESET_S` before the newest, or the last decision | a new clock: one stop | `stop` = clock |
| objects older than the runtime's `gap_s` | left out; nothing was heard, without newer ones | `left_out_old` |
| acceleration older than `gap_s` before the odometry | not known: the runtime stops | `stop` = ego_state |
| street or parked vehicles that make no street | the street before is kept | `street` |
| no street, or no acceleration yet | no trajectory; the debug topic says what is missing | level ERROR |
"""

import math
import time
from collections import Counter
from typing import Any

from negopipe.deployment.host_street import HostStreet
from negopipe.deployment.messages import Array, EgoState, ObjectState, Trajectory
from negopipe.deployment.middleware.codec import Message
from negopipe.deployment.middleware.incoming import (
    NS,
    ego_state,
    kerbs,
    object_states,
    parked_boxes,
    speed_at,
    speed_limits,
    stamp_ns,
)
from negopipe.deployment.middleware.interface import (
    ACCELERATION,
    DEBUG,
    FRAME,
    OBJECTS,
    ODOMETRY,
    PARKED,
    SCENE,
    STREET,
    TRAJECTORY,
    Topic,
)
from negopipe.deployment.middleware.outgoing import (
    ERROR,
    debug_message,
    diagnostic_values,
    trajectory_message,
    verdict,
)
from negopipe.deployment.middleware.scene import scene_message
from negopipe.deployment.middleware.vehicle import Vehicle
from negopipe.deployment.negotiator import Negotiator
from negopipe.errors import UserError

RESET_S = 1.0
"""Step of the stamps back by which a clock is a new one, not a message late, s."""

Outputs = list[tuple[Topic, Message]]
"""What a decision says."""


class PlanningNode:
    """The node of one vehicle on one drive.

    period_s: time between two decisions, of the export's control step or less
    """

    def __init__(self, negotiator: Negotiator, vehicle: Vehicle, period_s: float) -> None:
        self._negotiator, self._vehicle, self._period_ns = negotiator, vehicle, round(period_s * NS)
        self._newest: dict[Topic, Message] = {}
        self._heard: list[Message] = []
        self._left_out: Counter[str] = Counter()
        self._origin_ns = 0
        self._decided_ns: int | None = None
        self._has_moved = False  # an odometry was taken in since then
        self._objects_ns: int | None = None
        self._street: HostStreet | None = None
        self._limits: Array | None = None
        self._street_text = "none yet"
        self._is_new_street = False

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest odometry, None before the first one."""
        return stamp_ns(self._newest[ODOMETRY]) if ODOMETRY in self._newest else None

    def take(self, topic: Topic, message: Message) -> None:
        """Take in a message of an input."""
        if message.header.frame_id != FRAME and topic is not ACCELERATION:  # which is in that of the vehicle
            self._left_out["frame"] += 1
        elif topic is OBJECTS:
            self._heard.append(message)
        elif topic in (ODOMETRY, ACCELERATION):
            if topic is ODOMETRY and ODOMETRY not in self._newest:
                self._origin_ns = stamp_ns(message)
            self._take_newer(topic, message)
        else:
            self._newest[topic] = message
            self._is_new_street = True

    def due(self) -> int | None:
        """Stamp of the decision that is due, ns; None where there is none."""
        newest_ns = self.newest_ns
        if newest_ns is None or not self._has_moved:
            return None
        if self._decided_ns is None or newest_ns - self._decided_ns >= self._period_ns:
            return newest_ns
        return newest_ns if self._decided_ns - newest_ns > RESET_S * NS else None

    def decide(self, stamp: int) -> Outputs:
        """The decision for a time, ns: the newest odometry's, or later where the odometry has fallen silent."""
        began = time.perf_counter()
        self._decided_ns, self._has_moved = stamp, False
        self._build_street()
        objects, ages = self._objects(stamp), self._ages(stamp)
        try:
            plan = self._plan(stamp, objects)
        except UserError as error:
            return [(DEBUG, debug_message(stamp, ERROR, str(error), self._values(ages)))]
        measured_z = self._newest[ODOMETRY].pose.pose.position.z
        z = measured_z if math.isfinite(measured_z) else 0.0
        level, text = verdict(plan)
        values = diagnostic_values(plan) | self._values(ages) | {"decision_ms": (time.perf_counter() - began) * 1e3}
        assert self._limits is not None
        return [
            (TRAJECTORY, trajectory_message(plan, stamp, z, self._vehicle)),
            (DEBUG, debug_message(stamp, level, text, values)),
            (SCENE, self._scene(plan, objects or [], stamp, z)),
        ]

    def _scene(self, plan: Trajectory, objects: list[ObjectState], stamp: int, z: float) -> Message:
        street, parked = self._newest[STREET], self._newest.get(PARKED)
        return scene_message(plan, objects, street, parked, self._negotiator.settings.ego, stamp, z)

    def _take_newer(self, topic: Topic, message: Message) -> None:
        if topic in self._newest:
            older_ns = stamp_ns(self._newest[topic]) - stamp_ns(message)
            if 0 <= older_ns <= RESET_S * NS:
                self._left_out["old"] += 1
                return
        self._newest[topic] = message
        self._has_moved |= topic is ODOMETRY

    def _build_street(self) -> None:
        """Make the street of the newest kerbs and parked vehicles, where these are new."""
        if not self._is_new_street or STREET not in self._newest:
            return
        self._is_new_street = False
        path = self._newest[STREET]
        try:
            limits = speed_limits(path)
            self._street = self._negotiator.street_between(*kerbs(path), parked_boxes(self._newest.get(PARKED)))
        except UserError as error:
            self._street_text = str(error)
        else:
            self._limits, self._street_text = limits, "known"

    def _objects(self, stamp: int) -> list[ObjectState] | None:
        """Messages since the last decision; None where nothing was heard that is new enough."""
        oldest_ns = stamp - round(self._negotiator.settings.gap_s * NS)
        fresh = [message for message in self._heard if stamp_ns(message) >= oldest_ns]
        self._left_out["old"] += len(self._heard) - len(fresh)
        self._heard = []
        if not fresh:
            return None
        self._objects_ns = max(stamp_ns(message) for message in fresh)
        return [state for message in fresh for state in object_states(message, self._origin_ns)]

    def _plan(self, stamp: int, objects: list[ObjectState] | None) -> Trajectory:
        if self._street is None:
            raise UserError(f"street must be known before the first decision, got {self._street_text}")
        if ACCELERATION not in self._newest:
            raise UserError("acceleration must be known before the first decision, got none yet")
        return self._negotiator.decide(self._ego(), objects, self._street, (stamp - self._origin_ns) / NS)

    def _ego(self) -> EgoState:
        odometry, acceleration = self._newest[ODOMETRY], self._newest[ACCELERATION]
        position = odometry.pose.pose.position
        assert self._limits is not None
        apart_s = (stamp_ns(odometry) - stamp_ns(acceleration)) / NS
        is_known = abs(apart_s) <= self._negotiator.settings.gap_s
        accel = acceleration.accel.accel.linear.x if is_known else math.nan
        speed = speed_at(self._limits, position.x, position.y)
        return ego_state(odometry, accel, speed, self._vehicle, self._origin_ns)

    def _ages(self, stamp: int) -> dict[str, float]:
        """Time since the newest message of each input, s; NaN before the first one."""
        stamps = {topic: stamp_ns(self._newest[topic]) for topic in (ODOMETRY, ACCELERATION) if topic in self._newest}
        stamps |= {} if self._objects_ns is None else {OBJECTS: self._objects_ns}
        names = {"odometry": ODOMETRY, "acceleration": ACCELERATION, "objects": OBJECTS}
        return {
            f"{name}_age_s": (stamp - stamps[topic]) / NS if topic in stamps else math.nan
            for name, topic in names.items()
        }

    def _values(self, ages: dict[str, float]) -> dict[str, Any]:
        """Values of the debug topic that are the node's own; what was left out is counted from the last decision on."""
        left_out, self._left_out = self._left_out, Counter()
        return {**ages, "street": self._street_text, **{f"left_out_{word}": n for word, n in sorted(left_out.items())}}
