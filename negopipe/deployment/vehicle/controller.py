"""The tracking controller: Stanley's law with the path's curvature fed forward, PI of the speed with its acceleration.

The point that is held on the path is the middle of the footprint, since the plan is one of footprints. Its course
differs from the heading of the car in a bend (`body.slip_of`). Stanley's law holds the front axle on the path, which
would lead the footprint to the inside. Source: Hoffmann et al., "Autonomous automobile trajectory tracking for
off-road driving", ACC 2007.
"""

import math

from negopipe.deployment.history import wrapped
from negopipe.deployment.vehicle.actuators import Command
from negopipe.deployment.vehicle.body import CarState, Geometry, slip_of, steer_of
from negopipe.deployment.vehicle.options import ControllerConfig
from negopipe.deployment.vehicle.path import Path, Reference, error

STILL_MPS = 0.05
"""Speed below which a plan is at rest, m/s."""
HOLDING_MPS2 = 1.0
"""Deceleration that brakes are asked for at rest, m/s2."""


class Controller:
    """The controller of one drive; it remembers the gear and the angle at which it stopped."""

    def __init__(self, config: ControllerConfig, geometry: Geometry) -> None:
        self.config, self._geometry = config, geometry
        self._gear, self._steer = 1.0, 0.0

    def command(self, path: Path, time_s: float, car: CarState) -> Command:
        """What to ask of the actuators now; car: its state as far as it is known."""
        config, reference = self.config, path.at(time_s)
        lead = path.at(time_s + config.accel_lead_s)
        if abs(lead.speed) > STILL_MPS:
            self._gear = math.copysign(1.0, lead.speed)
        is_resting = max(abs(reference.speed), abs(lead.speed)) <= STILL_MPS and abs(car.speed) < config.holding_mps
        if is_resting:
            return Command(-self._gear * HOLDING_MPS2, self._steer, self._gear)
        self._steer = self._steering(path, car)
        return Command(self._acceleration(reference, lead, car), self._steer, self._gear)

    def _acceleration(self, reference: Reference, lead: Reference, car: CarState) -> float:
        """The plan's, and back to its speed and its place; the place is the integral of the speed."""
        config = self.config
        ahead_m, _, _ = error(reference, car.x, car.y, car.yaw)
        return lead.accel + config.speed_gain_1ps * (reference.speed - car.speed) - config.place_gain_1ps2 * ahead_m

    def _steering(self, path: Path, car: CarState) -> float:
        config, wheelbase_m, gear = self.config, self._geometry.wheelbase_m, self._gear
        here = path.abreast(car.x, car.y)
        preview_m = max(abs(car.speed) * config.steer_lead_s, config.preview_least_m)
        slip = slip_of(path.curvature(here.along_m), wheelbase_m)
        if gear > 0:
            back = -math.atan(config.left_gain_1ps * here.left_m / (max(car.speed, 0.0) + config.softening_mps))
        else:
            back = math.atan(config.reverse_gain_1pm * here.left_m)
        turn = wrapped(here.yaw - slip + back - car.yaw)
        return steer_of(path.curvature(here.along_m + preview_m), wheelbase_m) + gear * config.heading_gain * turn
