"""The multi-body car of commonroad-vehicle-models: 29 states, tyres by the magic formula, parameters of real cars.

Althoff, Koschi & Manzinger, "CommonRoad: Composable benchmarks for motion planning on roads", IV 2017. The package is
the extra `vehicle`.
"""

import math
from importlib import import_module
from typing import Any

from negopipe.deployment.vehicle.body import Body, Geometry
from negopipe.errors import UserError

NUMBERS = {"ford_escort": 1, "bmw_320i": 2, "vw_vanagon": 3}
"""Number of the parameters of a car in commonroad-vehicle-models."""


class MultiBody:
    """One car; it must move forwards.

    The state's reference is the centre of mass. An explicit step of Euler of 1 ms is what the package's authors
    take; the wheels' spin rings with longer ones.
    """

    def __init__(self, car: str) -> None:
        """car: one of `NUMBERS`. UserError where the package is missing."""
        try:
            made = import_module(f"vehiclemodels.parameters_vehicle{NUMBERS[car]}")
            self._derivatives = import_module("vehiclemodels.vehicle_dynamics_mb").vehicle_dynamics_mb
            self._initial = import_module("vehiclemodels.init_mb").init_mb
        except ImportError as error:
            raise UserError(
                "a car needs commonroad-vehicle-models (pip install negopipe[vehicle]), got no such package"
            ) from error
        self._parameters: Any = getattr(made, f"parameters_vehicle{NUMBERS[car]}")()
        steering = self._parameters.steering
        wheelbase_m = self._parameters.a + self._parameters.b
        self.geometry = Geometry(wheelbase_m, steering.max, steering.v_max)
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
