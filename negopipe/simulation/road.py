"""The road: kerbs, parked cars, the corridor between them, and the route that a vehicle follows through it."""

import math
from typing import Literal, NamedTuple

import torch
from pydantic import model_validator
from torch import Tensor

from negopipe.schema import NonNegativeMetres, PositiveInt, PositiveMetres, schema
from negopipe.simulation.geometry import Boxes, smoothstep, wrap_angle
from negopipe.simulation.off_road import off_road_boxes
from negopipe.simulation.reference_line import BendConfig, ReferenceLine, check_bends
from negopipe.simulation.state import VehicleState

KERB_STEP_M = 0.5
"""Spacing of the points of a drawn kerb, m."""


@schema
class RoadConfig:
    """Sizes of the road in metres; `conf/scenario/narrow_lane.yaml` says what each value means."""

    bends: list[BendConfig]
    width_m: PositiveMetres
    lane_offset_m: PositiveMetres
    corridor_length_m: PositiveMetres
    corridor_gap_m: PositiveMetres
    parked_sides: Literal["both", "left", "right"]
    parked_car_length_m: PositiveMetres
    parked_car_width_m: PositiveMetres
    n_parked_per_side: PositiveInt
    swerve_length_m: PositiveMetres
    swerve_margin_m: NonNegativeMetres
    target_distance_m: PositiveMetres

    @model_validator(mode="after")
    def _fits(self) -> "RoadConfig":
        n_rows = 2 if self.parked_sides == "both" else 1
        needed = self.corridor_gap_m + n_rows * self.parked_car_width_m
        if needed > self.width_m + 1e-6:
            raise ValueError(
                f"corridor_gap_m {self.corridor_gap_m} and parked_car_width_m {self.parked_car_width_m} need a "
                f"width_m of at least {needed:g} with parked_sides {self.parked_sides}, got {self.width_m}"
            )
        if self.n_parked_per_side * self.parked_car_length_m > self.corridor_length_m + 1e-6:
            raise ValueError(
                f"n_parked_per_side {self.n_parked_per_side} cars of {self.parked_car_length_m} m do not fit into "
                f"corridor_length_m {self.corridor_length_m} by their parked_car_length_m"
            )
        check_bends(self.bends, self.width_m)
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
    """A two-lane road along its reference line, on which the corridor's middle is sigma = 0.

    reference: the line in the middle between the kerbs; sigma (m) along it towards +x, d (m) to its left
    parked_on_line: [P, 4] float32, sigma, d, length, width, m; each car stands along the line's tangent
    parked_cars: [P, 5] float32, x, y, yaw, length, width; world frame, m and rad
    corridor_sigma_m: (first, last) sigma of the corridor, m
    target_s_m: s at which a vehicle has arrived
    """

    def __init__(self, config: RoadConfig, device: torch.device | str = "cpu") -> None:
        self.config = config
        self.reference = ReferenceLine(config.bends, device)
        self.corridor_sigma_m = (-config.corridor_length_m / 2, config.corridor_length_m / 2)
        self.target_s_m = config.corridor_length_m + config.target_distance_m
        self._gap_middle_m = _gap_middle(config)
        self.parked_on_line = _park(config).to(device)
        sigma, d, length, width = self.parked_on_line.unbind(-1)
        yaw = self.reference.heading(sigma)
        self.parked_cars = torch.stack([*self.reference.place(sigma, d), yaw, length, width], dim=-1)

    def parked_boxes(self) -> Boxes:
        """Footprints of the parked cars, fields [P], world frame."""
        x, y, yaw, length, width = self.parked_cars.unbind(-1)
        return Boxes(x, y, torch.cos(yaw), torch.sin(yaw), length / 2, width / 2)

    def off_road_boxes(self) -> Boxes:
        """Rectangles that cover the area beyond the kerbs, as far as a vehicle sees; fields [R], world frame."""
        return off_road_boxes(self.reference, self.config.width_m, self.parked_cars.device)

    def kerb_lines(self, first_m: float, last_m: float) -> Tensor:
        """Points of the right and the left kerb from sigma `first_m` to `last_m`, [2, K, 2] float32, m, world."""
        n_points = max(2, math.ceil((last_m - first_m) / KERB_STEP_M) + 1)
        sigma = torch.linspace(first_m, last_m, n_points, device=self.parked_cars.device)
        half = torch.full_like(sigma, self.config.width_m / 2)
        return torch.stack([torch.stack(self.reference.place(sigma, d), dim=-1) for d in (-half, half)])

    def is_off_road(self, boxes: Boxes) -> Tensor:
        """[...] bool: a footprint (fields [...], world frame) reaches over a kerb.

        On a bent road the corners and the middles of the long sides are tested: a side of 4.5 m across an inner
        kerb of radius 20 m reaches at most 4 cm deeper between two of these points.
        """
        half_road = self.config.width_m / 2
        if self.reference.is_straight:
            reach = boxes.half_length * boxes.sin.abs() + boxes.half_width * boxes.cos.abs()
            return boxes.y.abs() + reach > half_road
        x, y = _rim(boxes)
        return self.reference.project(x, y)[1].abs().amax(0) > half_road

    def route_offset(self, s: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Offset d (m) of the route at s [...], with d' (1) and d'' (1/m) by s: own lane, corridor, own lane.

        Outside the corridor the route keeps right (negative d), inside it follows the gap's middle line; it is
        symmetric about the corridor's middle. `direction` (+1 or -1) broadcasts with s.
        """
        config = self.config
        half = config.corridor_length_m / 2
        from_middle = s - half
        rate = 1 / config.swerve_length_m  # the planner's innermost loop: a product costs less than a division
        step, step_prime, step_pprime = smoothstep((from_middle.abs() - half - config.swerve_margin_m) * rate)
        step_prime = step_prime * torch.sign(from_middle) * rate
        step_pprime = step_pprime * rate**2
        if self._gap_middle_m == 0:
            lane = -config.lane_offset_m
            return lane * step, lane * step_prime, lane * step_pprime
        middle = direction * self._gap_middle_m
        shift = -config.lane_offset_m - middle
        return middle + shift * step, shift * step_prime, shift * step_pprime

    def curvature(self, s: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """kappa (1/m, positive to the left) and kappa' (1/m2, by s) of the line at s [...], seen by a driver.

        `direction` (+1 or -1) broadcasts with s.
        """
        kappa, kappa_prime = self.reference.curvature(self._sigma(s, direction))
        return direction * kappa, kappa_prime

    def progress(self, position: Tensor, direction: Tensor) -> Tensor:
        """s [...] (m) of world positions [..., 2] for vehicles that drive in `direction` [...] (+1 or -1)."""
        sigma, _ = self.reference.project(*position.unbind(-1))
        return direction * sigma + self.config.corridor_length_m / 2

    def in_tangent_frame(
        self, at_s: Tensor, direction: Tensor, ahead: Tensor, d: Tensor, d_prime: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Points near s = `at_s` in the frame that is tangent to the line there.

        Two vehicles a few metres apart are compared in a plane, not along a curve. The line is taken as an arc
        around `at_s`, to second order in the angle between the two places.

        at_s, ahead: m, place of the frame, and distance of the point ahead of it along the line
        d, d_prime: m and 1, offset of the point and its derivative along its path, in the route frame
        Returns u and v (m, ahead and to the left of the frame's origin on the line) and the tangent of the heading.
        """
        if self.reference.is_straight:
            return ahead, d, d_prime
        kappa, _ = self.curvature(at_s, direction)
        angle = (kappa * ahead).clamp(-0.5, 0.5)
        scale = 1 - kappa * d
        tan = d_prime / scale
        return scale * ahead, d + scale * angle * ahead / 2, tan + angle * (1 + tan**2)

    def direction_of(self, vehicles: VehicleState) -> Tensor:
        """Driving direction of vehicles [...] by their yaw: +1 along the line, -1 against it."""
        heading = vehicles.yaw
        if not self.reference.is_straight:
            sigma, _ = self.reference.project(*vehicles.position.unbind(-1))
            heading = heading - self.reference.heading(sigma)
        return torch.where(torch.cos(heading) < 0, -1.0, 1.0)

    def to_route(self, vehicles: VehicleState, direction: Tensor) -> RouteState:
        """World frame -> route frame of the driving direction [...] (+1 along the line, -1 against it).

        Werling 2010, Appendix I, with `path_per_road` the metres of path per metre of the line, `kappa_d_prime` the
        derivative (kappa d)' and `heading_prime` the rate at which the heading turns relative to the line, all by s.
        """
        if self.reference.is_straight:
            return self._to_straight_route(vehicles, direction)
        sigma, d = self.reference.project(*vehicles.position.unbind(-1))
        d = direction * d
        kappa, kappa_prime = self.reference.curvature(sigma)
        kappa = direction * kappa
        heading = wrap_angle(vehicles.yaw - self.reference.heading(sigma) - (1 - direction) * (math.pi / 2))
        scale, cos, tan = 1 - kappa * d, torch.cos(heading), torch.tan(heading)
        path_per_road = scale / cos
        d_prime = scale * tan
        kappa_d_prime = kappa_prime * d + kappa * d_prime
        heading_prime = vehicles.curvature * path_per_road - kappa
        s_dot = vehicles.speed / path_per_road
        s_ddot = (vehicles.accel - s_dot**2 * (d_prime * heading_prime - kappa_d_prime) / cos) / path_per_road
        s = direction * sigma + self.config.corridor_length_m / 2
        return RouteState(s, s_dot, s_ddot, d, d_prime, path_per_road * heading_prime / cos - kappa_d_prime * tan)

    def to_world(self, route: RouteState, direction: Tensor) -> VehicleState:
        """Route frame -> world frame, the inverse of `to_route`."""
        if self.reference.is_straight:
            return self._to_straight_world(route, direction)
        sigma = self._sigma(route.s, direction)
        kappa, kappa_prime = self.reference.curvature(sigma)
        kappa = direction * kappa
        scale = 1 - kappa * route.d
        kappa_d_prime = kappa_prime * route.d + kappa * route.d_prime
        heading = torch.atan(route.d_prime / scale)
        cos, tan = torch.cos(heading), route.d_prime / scale
        path_per_road = scale / cos
        heading_prime = (route.d_pprime + kappa_d_prime * tan) * cos / path_per_road
        yaw = heading + self.reference.heading(sigma) + (1 - direction) * (math.pi / 2)
        return VehicleState(
            position=torch.stack(self.reference.place(sigma, direction * route.d), dim=-1),
            yaw=wrap_angle(yaw),
            speed=route.s_dot * path_per_road,
            accel=route.s_ddot * path_per_road + route.s_dot**2 * (route.d_prime * heading_prime - kappa_d_prime) / cos,
            curvature=(heading_prime + kappa) / path_per_road,
        )

    def _to_straight_route(self, vehicles: VehicleState, direction: Tensor) -> RouteState:
        heading = wrap_angle(vehicles.yaw - (1 - direction) * (math.pi / 2))
        d_prime = torch.tan(heading)
        path_per_road = torch.sqrt(1 + d_prime**2)
        d_pprime = vehicles.curvature * path_per_road**3
        s_dot = vehicles.speed / path_per_road
        s_ddot = (vehicles.accel - s_dot**2 * d_prime * d_pprime / path_per_road) / path_per_road
        s = self.progress(vehicles.position, direction)
        return RouteState(s, s_dot, s_ddot, direction * vehicles.position[..., 1], d_prime, d_pprime)

    def _to_straight_world(self, route: RouteState, direction: Tensor) -> VehicleState:
        path_per_road = torch.sqrt(1 + route.d_prime**2)
        heading = torch.atan(route.d_prime)
        return VehicleState(
            position=torch.stack([self._sigma(route.s, direction), direction * route.d], dim=-1),
            yaw=wrap_angle(heading + (1 - direction) * (math.pi / 2)),
            speed=route.s_dot * path_per_road,
            accel=route.s_ddot * path_per_road + route.s_dot**2 * route.d_prime * route.d_pprime / path_per_road,
            curvature=route.d_pprime / path_per_road**3,
        )

    def _sigma(self, s: Tensor, direction: Tensor) -> Tensor:
        return direction * (s - self.config.corridor_length_m / 2)


def _gap_middle(config: RoadConfig) -> float:
    """d (m) of the middle line between the parked cars, or between them and the opposite kerb."""
    towards_free_kerb = {"both": 0, "left": -1, "right": 1}[config.parked_sides]
    return towards_free_kerb * (config.width_m - config.corridor_gap_m) / 2


def _park(config: RoadConfig) -> Tensor:
    """[P, 4] float32: the rows of parked cars on the line, evenly spread so that each row fills the corridor."""
    n, length, width = config.n_parked_per_side, config.parked_car_length_m, config.parked_car_width_m
    last = (config.corridor_length_m - length) / 2
    sigma = torch.linspace(-last, last, n) if n > 1 else torch.zeros(1)
    size = torch.tensor([length, width]).expand(n, 2)
    from_middle = (config.corridor_gap_m + width) / 2
    sides = {"both": (-1, 1), "left": (1,), "right": (-1,)}[config.parked_sides]
    rows = [torch.full((n, 1), _gap_middle(config) + side * from_middle) for side in sides]
    return torch.cat([torch.cat([sigma[:, None], d, size], dim=1) for d in rows])


def _rim(boxes: Boxes) -> tuple[Tensor, Tensor]:
    """Positions x, y [6, ...] (m) of the corners and of the middles of the long sides."""
    points = [(ahead, left) for left in (1.0, -1.0) for ahead in (1.0, 0.0, -1.0)]
    offsets = [(ahead * boxes.half_length, left * boxes.half_width) for ahead, left in points]
    x = torch.stack([boxes.x + u * boxes.cos - v * boxes.sin for u, v in offsets])
    y = torch.stack([boxes.y + u * boxes.sin + v * boxes.cos for u, v in offsets])
    return x, y
