"""The multi-body car of commonroad-vehicle-models: 29 states, tyres by the magic formula, parameters of real cars.

Althoff, Koschi & Manzinger, "CommonRoad: Composable benchmarks for motion planning on roads", IV 2017. The package is
the extra `vehicle`.
"""

import math
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

from negopipe.deployment.vehicle.body import Body, Geometry
from negopipe.errors import UserError

NUMBERS = {"ford_escort": 1, "bmw_320i": 2, "vw_vanagon": 3}
"""Number of the parameters of a car in commonroad-vehicle-models."""


class _Package(NamedTuple):
    """What is used of the package: the parameters of a car, its derivatives, its state of balance."""

    parameters: Any
    derivatives: Callable[[list[float], list[float], Any], list[float]]
    initial: Callable[[list[float], Any], list[float]]


@cache
def _of_package(car: str) -> _Package:
    """Read once: the package takes a second to read the parameters."""
    name = f"parameters_vehicle{NUMBERS[car]}"
    try:
        parameters = getattr(import_module(f"vehiclemodels.{name}"), name)()
        derivatives = import_module("vehiclemodels.vehicle_dynamics_mb").vehicle_dynamics_mb
        initial = import_module("vehiclemodels.init_mb").init_mb
    except ImportError as error:
        raise UserError(
            "a car needs commonroad-vehicle-models (pip install 'negopipe[vehicle]'), got no such package"
        ) from error
    return _Package(parameters, derivatives, initial)


class MultiBody:
    """One car; it must move forwards.

    The state's reference is the centre of mass. Steps are explicit ones of Euler; the wheels' spin is stiff, so they
    must be short.
    """

    def __init__(self, car: str) -> None:
        """car: one of `NUMBERS`. UserError where the package is missing."""
        self._parameters, self._derivatives, self._initial = _of_package(car)
        steering = self._parameters.steering
        self.geometry = Geometry(self._parameters.a + self._parameters.b, steering.max, steering.v_max)
        self._state: list[float] = []

    def start(self, body: Body) -> None:
        """Put the car into a motion, in the balance of forces of driving straight on."""
        rear_m = self._parameters.b
        lateral = body.lateral + rear_m * body.yaw_rate
        x = body.x + rear_m * math.cos(body.yaw)
        y = body.y + rear_m * math.sin(body.yaw)
        speed, slip = math.hypot(body.speed, lateral), math.atan2(lateral, body.speed)
        self._state = self._initial([x, y, body.steer, speed, body.yaw, body.yaw_rate, slip], self._parameters)

    def step(self, steer_rate: float, accel: float, step_s: float) -> None:
        """Move on by one step; steer_rate: rad/s, accel: m/s2, asked of the wheels."""
        change = self._derivatives(self._state, [steer_rate, accel], self._parameters)
        self._state = [value + step_s * rate for value, rate in zip(self._state, change, strict=True)]

    @property
    def body(self) -> Body:
        x, y, steer, speed, yaw, yaw_rate = self._state[:6]
        rear_m, lateral = self._parameters.b, self._state[10]
        return Body(
            x - rear_m * math.cos(yaw),
            y - rear_m * math.sin(yaw),
            yaw,
            speed,
            lateral - rear_m * yaw_rate,
            yaw_rate,
            steer,
        )
