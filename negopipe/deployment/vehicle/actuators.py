"""Pedals and steering: first-order lags, and the largest rate of the steering."""

from typing import NamedTuple

from negopipe.deployment.vehicle.body import Geometry
from negopipe.deployment.vehicle.options import ActuatorConfig


class Command(NamedTuple):
    """What a controller asks for: acceleration along the car's axis (m/s2), steering angle (rad), gear (+1 or -1)."""

    accel: float
    steer: float
    gear: float


class Actuators:
    """The acceleration that drive train and brakes give now, and the rate of the steering.

    accel: m/s2
    """

    def __init__(self, config: ActuatorConfig, geometry: Geometry, step_s: float) -> None:
        self.accel = 0.0
        self._share = step_s / config.accel_time_constant_s
        self._steer_time_constant_s = config.steer_time_constant_s
        self._geometry, self._config = geometry, config

    def step(self, command: Command, steer: float) -> tuple[float, float]:
        """Rate of the wheels' angle (rad/s) and acceleration (m/s2) in one step; steer: rad, angle now."""
        config, geometry = self._config, self._geometry
        wanted = max(-config.decel_max_mps2, min(config.accel_max_mps2, command.gear * command.accel))
        self.accel += self._share * (command.gear * wanted - self.accel)
        angle = max(-geometry.steer_max_rad, min(geometry.steer_max_rad, command.steer))
        most = geometry.steer_rate_max_radps
        rate = max(-most, min(most, (angle - steer) / self._steer_time_constant_s))
        return rate, self.accel
