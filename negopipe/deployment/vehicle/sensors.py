"""What the vehicle knows of itself and of the others: late, noisy and with gaps, as messages of the runtime."""

import math
from dataclasses import dataclass

import numpy as np

from negopipe.deployment.history import wrapped
from negopipe.deployment.messages import Array, EgoState, ObjectState
from negopipe.deployment.vehicle.body import CarState
from negopipe.deployment.vehicle.channel import ROUNDING_S, Channel
from negopipe.deployment.vehicle.options import LocalisationConfig, ObjectsConfig


@dataclass(frozen=True)
class Others:
    """The other vehicles as they are; rows [O, 6]: x, y (m), yaw (rad), speed (m/s), length, width (m)."""

    time_s: float
    rows: Array

    def at(self, time_s: float, before: "Others") -> Array:
        """Rows at a time between `before` and this one."""
        share = (time_s - before.time_s) / (self.time_s - before.time_s)
        rows = before.rows + share * (self.rows - before.rows)
        turned = (self.rows[:, 2] - before.rows[:, 2] + math.pi) % (2 * math.pi) - math.pi
        rows[:, 2] = before.rows[:, 2] + share * turned
        return rows

    def driven_back(self, time_s: float) -> "Others":
        """The others as they came, at an earlier time, with their speed and heading."""
        rows, back_m = self.rows.copy(), self.rows[:, 3] * (self.time_s - time_s)
        rows[:, 0] -= back_m * np.cos(rows[:, 2])
        rows[:, 1] -= back_m * np.sin(rows[:, 2])
        return Others(time_s, rows)


class ObjectSensor:
    """Frames of the others."""

    def __init__(self, config: ObjectsConfig, rng: np.random.Generator) -> None:
        self.config, self._rng = config, rng
        self._channel: Channel[list[ObjectState]] = Channel()
        self._last: Others | None = None
        self._next_frame_s = -config.seen_before_s

    def hear(self, others: Others) -> list[ObjectState] | None:
        """What has arrived since the last call, None where that is not even an empty frame; others: as they are now."""
        before = self._last or others.driven_back(self._next_frame_s - self.config.period_s)
        while self._next_frame_s <= others.time_s + ROUNDING_S:
            self._send(self._next_frame_s, others.at(self._next_frame_s, before))
            self._next_frame_s += self.config.period_s
        self._last = others
        frames = self._channel.receive(others.time_s)
        return [message for frame in frames for message in frame] if frames else None

    def _send(self, time_s: float, rows: Array) -> None:
        config, rng = self.config, self._rng
        deviations = (config.position_std_m, config.position_std_m, config.yaw_std_rad, config.speed_std_mps)
        seen = rows[:, :4] + rng.normal(size=(len(rows), 4)) * deviations
        is_lost = rng.random(len(rows)) < config.lost_objects
        latency_s, is_gone = rng.uniform(*config.latency_s), rng.random() < config.lost_frames
        if is_gone:
            return
        frame = [
            ObjectState(f"car {number}", time_s, x, y, yaw, speed, *map(float, size))
            for number, ((x, y, yaw, speed), size) in enumerate(zip(seen.tolist(), rows[:, 4:], strict=True))
            if not is_lost[number]
        ]
        self._channel.send(frame, time_s + latency_s)


class Localisation:
    """The own state as the vehicle knows it."""

    def __init__(self, config: LocalisationConfig, desired_speed: float, rng: np.random.Generator) -> None:
        """desired_speed: m/s, of the messages."""
        self.config, self._desired_speed, self._rng = config, desired_speed, rng
        self._channel: Channel[EgoState] = Channel()
        self._newest: EgoState | None = None

    def measure(self, time_s: float, car: CarState) -> None:
        """Take the state at a time; it is known `delay_s` later."""
        config = self.config
        x, y, yaw, speed = self._rng.normal(size=4).tolist()
        message = EgoState(
            time_s,
            car.x + config.position_std_m * x,
            car.y + config.position_std_m * y,
            wrapped(car.yaw + config.yaw_std_rad * yaw),
            car.speed + config.speed_std_mps * speed,
            car.accel,
            car.curvature,
            self._desired_speed,
        )
        self._channel.send(message, time_s + config.delay_s)

    def newest(self, now_s: float) -> EgoState:
        """The newest state that is known; the first is taken `delay_s` before the start or earlier."""
        for message in self._channel.receive(now_s):
            self._newest = message
        assert self._newest is not None
        return self._newest


def carried_on(message: EgoState, now_s: float) -> CarState:
    """The state now, if speed and curvature are what they were."""
    driven = message.speed * (now_s - message.time_s)
    middle = message.yaw + message.curvature * driven / 2
    return CarState(
        message.x + driven * math.cos(middle),
        message.y + driven * math.sin(middle),
        wrapped(message.yaw + message.curvature * driven),
        message.speed,
        message.accel,
        message.curvature,
    )
