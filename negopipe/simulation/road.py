"""A road of one or many streets: the frames of its routes, and what stands beside them.

A road is a set of streets. Every world drives on one of them, and a vehicle's `direction` names the street and the way
along it. `OneStreet` computes its only street in closed form, `Streets` looks many of them up in tables.
"""

import math
from abc import ABC, abstractmethod
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from negopipe.simulation.geometry import Boxes, wrap_angle
from negopipe.simulation.state import VehicleState


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


DRAWN_M = 0.5
"""Spacing of the points of a drawn kerb, m."""


class Line(Protocol):
    """A reference line; sigma (m) is the arc length along it, d (m) the offset to its left."""

    def heading(self, sigma: Tensor) -> Tensor:
        """[...] rad, world; not wrapped."""

    def curvature(self, sigma: Tensor) -> tuple[Tensor, Tensor]:
        """kappa [...] (1/m, positive to the left) and its derivative kappa' [...] (1/m2) by arc length."""

    def pose(self, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x, y (m) and heading (rad) at sigma [...], world frame."""

    def place(self, sigma: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """x, y (m, world) of the points at an offset d from the line; the inverse of `project`."""

    def project(self, x: Tensor, y: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """sigma, d [...] (m) of world positions x, y [...] (m); near: sigma within a few metres, if known."""


class Road(ABC):
    """A road of B streets, on each of which the corridor's middle is sigma = 0.

    The corridor reaches from the first narrow place of a street to its last one.

    direction, in every method: [...] float32, broadcasts with the other arguments; `state.py` says what it means
    device: of all tensors
    n_streets: B
    is_straight: every street's line is the world's x axis (known before anything is computed)
    narrow_places: [2B, M, 2] float32, m, by way: first and last s of each narrow place, in the order in which they are
        met; streets with fewer than M repeat their last one
    n_places: [B] int64, narrow places of each street
    parked: [B, P, 6] float32, fields of `Boxes` in the world frame
    """

    device: torch.device
    n_streets: int
    is_straight: bool
    narrow_places: Tensor
    n_places: Tensor
    parked: Tensor

    @property
    @abstractmethod
    def off_road(self) -> Tensor:
        """[B, R, 6] float32, fields of `Boxes` in the world frame: the area beyond the kerbs, as far as one sees."""

    @abstractmethod
    def line(self, direction: Tensor) -> Line:
        """The reference line of the street."""

    @abstractmethod
    def sign(self, direction: Tensor) -> Tensor:
        """[...] float32: +1 along the line, -1 against it."""

    @abstractmethod
    def pick(self, table: Tensor, direction: Tensor) -> Tensor:
        """Rows of a table [B, ...] by street; for one street its only row, without an axis of streets."""

    @abstractmethod
    def corridor_m(self, direction: Tensor) -> Tensor | float:
        """[...] m: length of the corridor."""

    @abstractmethod
    def target_s(self, direction: Tensor) -> Tensor | float:
        """[...] m: s at which a vehicle has arrived."""

    @abstractmethod
    def route_offset(self, s: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Offset d (m) of the route at s [...], with d' (1) and d'' (1/m) by s: own lane, corridor, own lane.

        Outside the corridor the route keeps right (negative d), inside it follows the gap's middle line.
        """

    @abstractmethod
    def kerbs_at(self, sigma: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Distance of the right and of the left kerb from the line at sigma [...], m."""

    def parked_boxes(self, direction: Tensor | None = None) -> Boxes:
        """Footprints of the parked cars, fields [..., P], of one street [P]; None is the first street."""
        return self._boxes(self.parked, direction)

    def off_road_boxes(self, direction: Tensor | None = None) -> Boxes:
        """Rectangles that cover the area beyond the kerbs; fields [..., R], of one street [R]."""
        return self._boxes(self.off_road, direction)

    def _boxes(self, table: Tensor, direction: Tensor | None) -> Boxes:
        return Boxes(*self.pick(table, self._or_first(direction)).unbind(-1))

    def _or_first(self, direction: Tensor | None) -> Tensor:
        return torch.ones((), device=self.device) if direction is None else direction

    def kerb_lines(self, sigma: Tensor, direction: Tensor) -> Tensor:
        """Points of the right and the left kerb at sigma [K], [2, K, 2] float32, m, world; direction: of one street."""
        right, left = self.kerbs_at(sigma, direction.expand_as(sigma))
        line = self.line(direction)
        return torch.stack([torch.stack(line.place(sigma, d), dim=-1) for d in (-right, left)])

    def sampled(self, first_m: float, last_m: float) -> Tensor:
        """[K] float32, m: sigma every `DRAWN_M` at least from the first to the last."""
        n_points = max(2, math.ceil((last_m - first_m) / DRAWN_M) + 1)
        return torch.linspace(first_m, last_m, n_points, device=self.device)

    @abstractmethod
    def kerb_excess(self, s: Tensor, direction: Tensor, d: Tensor, reach: Tensor, sagitta: Tensor | float) -> Tensor:
        """[...] m: depth over a kerb of what reaches by `reach` (m) to both sides of d; sagitta: its bulge, m."""

    @abstractmethod
    def is_off_road(self, boxes: Boxes, direction: Tensor | None = None) -> Tensor:
        """[...] bool: a footprint (fields [...], world frame) reaches over a kerb.

        On a bent road the corners and the middles of the long sides are tested: a side of 4.5 m across an inner
        kerb of radius 20 m reaches at most 4 cm deeper between two of these points.
        """

    @property
    @abstractmethod
    def parked_on_line(self) -> list[list[tuple[float, float, float, float]]]:
        """sigma, d, length and width (m) of the cars parked on every street's road, each along the line's tangent."""

    @property
    def ways(self) -> Tensor:
        """[2B] float32: direction of every way: along the first street, against it, along the second, ..."""
        along = torch.arange(1.0, 1.0 + self.n_streets, device=self.device)
        return torch.stack([along, -along], -1).flatten()

    def way(self, direction: Tensor) -> Tensor:
        """[...] int64: index of a direction among `ways`."""
        return (2 * direction.abs() - 2 + (direction < 0)).long()

    def seen_by_oncoming(self, table: Tensor) -> Tensor:
        """A table [2B, M] of narrow places in which every way has the values of the opposite one, place by place."""
        opposite = table.unflatten(0, (-1, 2)).flip(1).flatten(0, 1)
        if table.shape[1] == 1:
            return opposite
        index = (self.n_places[:, None] - 1 - torch.arange(table.shape[1], device=self.device)).clamp(min=0)
        return opposite.gather(1, index.repeat_interleave(2, 0))

    def of_place(self, table: Tensor, ends: Tensor, s: Tensor, direction: Tensor) -> Tensor:
        """Values [...] of a table [2B, M]: of the first place that ends ahead of s [...], or of the last one.

        ends: [2B, M] m, s at which the places end
        """
        way, n = self.way(direction), table.shape[1]
        if n == 1:
            return table[:, 0][way]
        index = (s[..., None] > ends[way]).sum(-1).clamp(max=n - 1)
        return table.flatten()[way * n + index]

    def narrow_place(self, s: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """First and last s [...] (m) of the narrow place in which a vehicle at s is, or to which it comes next."""
        first, last = self.narrow_places.unbind(-1)
        return self.of_place(first, last, s, direction), self.of_place(last, last, s, direction)

    def sigma(self, s: Tensor, direction: Tensor) -> Tensor:
        """[...] m: arc length of the line at s [...]."""
        return self.sign(direction) * (s - self.corridor_m(direction) / 2)

    def curvature(self, s: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """kappa (1/m, positive to the left) and kappa' (1/m2, by s) of the line at s [...], seen by a driver."""
        kappa, kappa_prime = self.line(direction).curvature(self.sigma(s, direction))
        return self.sign(direction) * kappa, kappa_prime

    def progress(self, position: Tensor, direction: Tensor) -> Tensor:
        """s [...] (m) of world positions [..., 2] for vehicles that drive in `direction` [...]."""
        sigma, _ = self.line(direction).project(*position.unbind(-1))
        return self.sign(direction) * sigma + self.corridor_m(direction) / 2

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
        if self.is_straight:
            return ahead, d, d_prime
        kappa, _ = self.curvature(at_s, direction)
        angle = (kappa * ahead).clamp(-0.5, 0.5)
        scale = 1 - kappa * d
        tan = d_prime / scale
        return scale * ahead, d + scale * angle * ahead / 2, tan + angle * (1 + tan**2)

    def direction_of(self, vehicles: VehicleState, seen_from: Tensor) -> Tensor:
        """Direction of vehicles [...] by their yaw, on the street of the viewers' direction `seen_from`."""
        if self.is_straight:
            return _along(vehicles.yaw, seen_from.abs())
        line = self.line(seen_from)
        sigma, _ = line.project(*vehicles.position.unbind(-1))
        return _along(vehicles.yaw - line.heading(sigma), seen_from.abs())

    def to_own_route(self, vehicles: VehicleState, seen_from: Tensor) -> tuple[Tensor, RouteState]:
        """Direction of vehicles [...] by their yaw, and their motion in the route frame of that direction.

        seen_from: direction of the viewers
        """
        if self.is_straight:
            direction = self.direction_of(vehicles, seen_from)
            return direction, self._to_straight_route(vehicles, direction)
        line = self.line(seen_from)
        sigma, d = line.project(*vehicles.position.unbind(-1))
        direction = _along(vehicles.yaw - line.heading(sigma), seen_from.abs())
        return direction, self._to_bent_route(vehicles, direction, sigma, d)

    def to_route(self, vehicles: VehicleState, direction: Tensor) -> RouteState:
        """World frame -> route frame."""
        if self.is_straight:
            return self._to_straight_route(vehicles, direction)
        return self._to_bent_route(vehicles, direction, *self.line(direction).project(*vehicles.position.unbind(-1)))

    def _to_bent_route(self, vehicles: VehicleState, direction: Tensor, sigma: Tensor, d: Tensor) -> RouteState:
        """World frame -> route frame of vehicles that are at `sigma` and `d` of the line.

        Werling 2010, Appendix I, with `path_per_road` the metres of path per metre of the line, `kappa_d_prime` the
        derivative (kappa d)' and `heading_prime` the rate at which the heading turns relative to the line, all by s.
        """
        line, sign = self.line(direction), self.sign(direction)
        d = sign * d
        kappa, kappa_prime = line.curvature(sigma)
        kappa = sign * kappa
        heading = wrap_angle(vehicles.yaw - line.heading(sigma) - (1 - sign) * (math.pi / 2))
        scale, cos, tan = 1 - kappa * d, torch.cos(heading), torch.tan(heading)
        path_per_road = scale / cos
        d_prime = scale * tan
        kappa_d_prime = kappa_prime * d + kappa * d_prime
        heading_prime = vehicles.curvature * path_per_road - kappa
        s_dot = vehicles.speed / path_per_road
        s_ddot = (vehicles.accel - s_dot**2 * (d_prime * heading_prime - kappa_d_prime) / cos) / path_per_road
        s = sign * sigma + self.corridor_m(direction) / 2
        return RouteState(s, s_dot, s_ddot, d, d_prime, path_per_road * heading_prime / cos - kappa_d_prime * tan)

    def to_world(self, route: RouteState, direction: Tensor) -> VehicleState:
        """Route frame -> world frame, the inverse of `to_route`."""
        if self.is_straight:
            return self._to_straight_world(route, direction)
        line, sign, sigma = self.line(direction), self.sign(direction), self.sigma(route.s, direction)
        kappa, kappa_prime = line.curvature(sigma)
        kappa = sign * kappa
        scale = 1 - kappa * route.d
        kappa_d_prime = kappa_prime * route.d + kappa * route.d_prime
        heading = torch.atan(route.d_prime / scale)
        cos, tan = torch.cos(heading), route.d_prime / scale
        path_per_road = scale / cos
        heading_prime = (route.d_pprime + kappa_d_prime * tan) * cos / path_per_road
        yaw = heading + line.heading(sigma) + (1 - sign) * (math.pi / 2)
        return VehicleState(
            position=torch.stack(line.place(sigma, sign * route.d), dim=-1),
            yaw=wrap_angle(yaw),
            speed=route.s_dot * path_per_road,
            accel=route.s_ddot * path_per_road + route.s_dot**2 * (route.d_prime * heading_prime - kappa_d_prime) / cos,
            curvature=(heading_prime + kappa) / path_per_road,
        )

    def _to_straight_route(self, vehicles: VehicleState, direction: Tensor) -> RouteState:
        sign = self.sign(direction)
        heading = wrap_angle(vehicles.yaw - (1 - sign) * (math.pi / 2))
        d_prime = torch.tan(heading)
        path_per_road = torch.sqrt(1 + d_prime**2)
        d_pprime = vehicles.curvature * path_per_road**3
        s_dot = vehicles.speed / path_per_road
        s_ddot = (vehicles.accel - s_dot**2 * d_prime * d_pprime / path_per_road) / path_per_road
        s = self.progress(vehicles.position, direction)
        return RouteState(s, s_dot, s_ddot, sign * vehicles.position[..., 1], d_prime, d_pprime)

    def _to_straight_world(self, route: RouteState, direction: Tensor) -> VehicleState:
        sign = self.sign(direction)
        path_per_road = torch.sqrt(1 + route.d_prime**2)
        heading = torch.atan(route.d_prime)
        return VehicleState(
            position=torch.stack([self.sigma(route.s, direction), sign * route.d], dim=-1),
            yaw=wrap_angle(heading + (1 - sign) * (math.pi / 2)),
            speed=route.s_dot * path_per_road,
            accel=route.s_ddot * path_per_road + route.s_dot**2 * route.d_prime * route.d_pprime / path_per_road,
            curvature=route.d_pprime / path_per_road**3,
        )


def _along(heading: Tensor, street: Tensor) -> Tensor:
    """[...]: direction on a street by the heading (rad) relative to its line."""
    return torch.where(torch.cos(heading) < 0, -street, street)
