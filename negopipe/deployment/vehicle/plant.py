"""A car that can stop: a model for driving, handed over to the kinematic one at walking pace and back.

The multi-body model never starts again once it stands, and it has no reverse gear.
"""

from typing import Protocol

from negopipe.deployment.vehicle.body import Body, Geometry
from negopipe.deployment.vehicle.kinematic import rolled

UP_AGAIN = 1.2
"""Speed at which the driving model takes over again, as a multiple of the one at which it hands over: both take turns
otherwise where a car drives at just that speed."""


class DrivingModel(Protocol):
    """A model of a car that drives forwards."""

    geometry: Geometry

    def start(self, body: Body) -> None: ...

    def step(self, steer_rate: float, accel: float, step_s: float) -> None: ...

    @property
    def body(self) -> Body: ...


class Plant:
    """A car.

    body: now
    is_driving: the driving model moves it, not the kinematic one
    """

    def __init__(self, model: DrivingModel, start: Body, hand_over_mps: float, step_s: float) -> None:
        self.geometry, self.body = model.geometry, start
        self._model, self._hand_over_mps, self._step_s = model, hand_over_mps, step_s
        self.is_driving = start.speed >= hand_over_mps
        if self.is_driving:
            model.start(start)

    def step(self, steer_rate: float, accel: float, gear: float) -> None:
        """Move on by one step; steer_rate: rad/s, accel: m/s2 along the car's axis, gear: +1 or -1."""
        if self.is_driving:
            self._model.step(steer_rate, accel, self._step_s)
            self.body = self._model.body
            self.is_driving = self.body.speed >= self._hand_over_mps
            return
        self.body = rolled(self.body, steer_rate, accel, gear, self.geometry, self._step_s)
        if self.body.speed >= UP_AGAIN * self._hand_over_mps:
            self._model.start(self.body)
            self.is_driving = True
