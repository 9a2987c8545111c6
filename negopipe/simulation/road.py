"""The road: kerbs, parked cars, the corridor between them, and the route that a vehicle follows through it."""

import math
from typing import NamedTuple

import torch
from pydantic import model_validator
from torch import Tensor

from negopipe.schema import NonNegativeFloat, PositiveFloat, PositiveInt, schema
from negopipe.simulation.geometry import Boxes, smoothstep, wrap_angle
from negopipe.simulation.state import VehicleState


@schema
class RoadConfig:
    """Sizes of the road in metres; see `conf/scenario/narrow_lane.yaml` for each one's meaning."""

    width_m: PositiveFloat
    lane_offset_m: PositiveFloat
    corridor_length_m: PositiveFloat
    corridor_gap_m: PositiveFloat
    parked_car_length_m: PositiveFloat
    parked_car_width_m: PositiveFloat
    n_parked_per_side: PositiveInt
    swerve_length_m: PositiveFloat
    swerve_margin_m: NonNegativeFloat
    target_distance_m: PositiveFloat

    @model_validator(mode="after")
    def _fits(self) -> "RoadConfig":
        outer = self.corridor_gap_m / 2 + self.parked_car_width_m
        if outer > self.width_m / 2 + 1e-6:
            raise ValueError(
                f"corridor_gap_m {self.corridor_gap_m} and parked_car_width_m {self.parked_car_width_m} need a "
                f"width_m of at least {2 * outer:g}, got {self.width_m}"
            )
        if self.n_parked_per_side * self.parked_car_length_m > self.corridor_length_m + 1e-6:
            raise ValueError(
                f"n_parked_per_side {self.n_parked_per_side} cars of {self.parked_car_length_m} m do not fit into "
                f"corridor_length_m {self.corridor_length_m}"
            )
        return self


class RouteState(NamedTuple):
    """Motion in the route frame of the road's reference line (`state.py`); every field [...], float32.

    s, s_dot, s_ddot: m, m/s, m/s2, along the own driving direction, s = 0 at the own mouth of the corridor
    d, d_prime, d_pprime: m, 1, 1/m, offset to the left and its derivatives by s (not by time: a vehicle that
        stands still has a heading and a curvature, and cannot slide sideways)
    """

    s: Tensor
    s_dot: Tensor
    s_ddot: Tensor
    d: Tensor
    d_prime: Tensor
    d_pprime: Tensor


class Road:
    """A straight two-lane road along the world's x axis whose corridor is centred at x = 0.

    parked_cars: [P, 5] float32, x, y, yaw, length, width; world frame, m and rad
    kerb_y_m: (right, left) y of the kerbs, m, world frame
    corridor_x_m: (first, last) x of the corridor, m, world frame
    target_s_m: s at which a vehicle has arrived
    """

    def __init__(self, config: RoadConfig, device: torch.device | str = "cpu") -> None:
        self.config = config
        self.kerb_y_m = (-config.width_m / 2, config.width_m / 2)
        self.corridor_x_m = (-config.corridor_length_m / 2, config.corridor_length_m / 2)
        self.target_s_m = config.corridor_length_m + config.target_distance_m
        self.parked_cars = _park(config).to(device)

    def parked_boxes(self) -> Boxes:
        """Footprints of the parked cars, fields [P], world frame."""
        x, y, yaw, length, width = self.parked_cars.unbind(-1)
        return Boxes(x, y, torch.cos(yaw), torch.sin(yaw), length / 2, width / 2)

    def route_offset(self, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where the route runs at s [...]: offset d (m), d' and d'' by s: own lane, corridor, own lane.

        Outside the corridor the route keeps right (negative d); it is symmetric about the corridor's middle.
        """
        config = self.config
        half = config.corridor_length_m / 2
        from_middle = s - half
        beyond = (from_middle.abs() - half - config.swerve_margin_m) / config.swerve_length_m
        value, slope, bend = smoothstep(beyond)
        slope = slope * torch.sign(from_middle) / config.swerve_length_m
        bend = bend / config.swerve_length_m**2
        return -config.lane_offset_m * value, -config.lane_offset_m * slope, -config.lane_offset_m * bend

    def progress(self, position: Tensor, direction: Tensor) -> Tensor:
        """s [...] (m) of world positions [..., 2] for vehicles that drive in `direction` [...] (+1 or -1)."""
        return direction * position[..., 0] + self.config.corridor_length_m / 2

    def to_route(self, vehicles: VehicleState, direction: Tensor) -> RouteState:
        """World frame -> route frame of the driving direction [...] (+1 along x, -1 against it)."""
        heading = wrap_angle(vehicles.yaw - (1 - direction) * (math.pi / 2))
        d_prime = torch.tan(heading)
        stretch = torch.sqrt(1 + d_prime**2)  # metres of path per metre of road
        d_pprime = vehicles.curvature * stretch**3
        s_dot = vehicles.speed / stretch
        s_ddot = (vehicles.accel - s_dot**2 * d_prime * d_pprime / stretch) / stretch
        s = self.progress(vehicles.position, direction)
        return RouteState(s, s_dot, s_ddot, direction * vehicles.position[..., 1], d_prime, d_pprime)

    def to_world(self, route: RouteState, direction: Tensor) -> VehicleState:
        """Route frame -> world frame, the inverse of `to_route`."""
        stretch = torch.sqrt(1 + route.d_prime**2)
        x = direction * (route.s - self.config.corridor_length_m / 2)
        heading = torch.atan(route.d_prime)
        return VehicleState(
            position=torch.stack([x, direction * route.d], dim=-1),
            yaw=wrap_angle(heading + (1 - direction) * (math.pi / 2)),
            speed=route.s_dot * stretch,
            accel=route.s_ddot * stretch + route.s_dot**2 * route.d_prime * route.d_pprime / stretch,
            curvature=route.d_pprime / stretch**3,
        )


def _park(config: RoadConfig) -> Tensor:
    """Both rows of parked cars [P, 5], evenly spread so that each row fills the corridor from end to end."""
    n, length, width = config.n_parked_per_side, config.parked_car_length_m, config.parked_car_width_m
    last = (config.corridor_length_m - length) / 2
    x = torch.linspace(-last, last, n) if n > 1 else torch.zeros(1)
    y = torch.full((n,), (config.corridor_gap_m + width) / 2)
    size = torch.tensor([0.0, length, width]).expand(n, 3)
    return torch.cat([torch.column_stack([x, side * y, size]) for side in (-1, 1)])
