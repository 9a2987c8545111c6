"""Collisions of footprints: at one instant, and between two control steps.

States are known at control steps only. In between, a vehicle is taken to move along the cubic that has its positions
and velocities at both ends, and to turn evenly. The motion is cut into pieces of at most `PIECE_S`. Within a piece
every footprint moves straight on with its mean heading, so the moment at which two footprints meet is exact
(`geometry.time_to_collision`): no vehicle is too short and no control step too long for a collision to be seen. The
footprints are shrunk by `GRAZE_M` and by as much as turning moves their corners within the piece. A contact found
between control steps is therefore a collision. A graze that is no deeper than the shrinkage may be missed there.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.simulation.geometry import Boxes, boxes_from_pose, overlap_depth, time_to_collision, wrap_angle
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.scenario import VehicleConfig
from negopipe.simulation.state import VehicleState
from negopipe.tensors.tree import tree_where

PIECE_S = 0.05
"""Longest piece of a motion between two control steps, s."""

GRAZE_M = 0.01
"""Depth of an overlap that counts as a graze, m: at 8 m/s2 the line of a piece and the cubic are half as far apart."""

PASSING_M = 0.3
"""Room on either side of a vehicle that passes another, m."""


class _Poses(NamedTuple):
    """Poses between two control steps, fields [E, V, N + 1], m and rad, world frame."""

    x: Tensor
    y: Tensor
    yaw: Tensor


class CollisionCheck:
    """Checks the true oriented footprints of V vehicles against each other, parked cars and kerbs.

    others: [V, V - 1] int64, for each vehicle the columns of all others
    """

    def __init__(self, road: Road, vehicle: VehicleConfig, dt_s: float, others: Tensor) -> None:
        self.road, self.vehicle, self.dt_s = road, vehicle, dt_s
        self._others = others
        self._n_pieces = math.ceil(dt_s / PIECE_S - 1e-9)
        self._share = torch.linspace(0, 1, self._n_pieces + 1, device=others.device)
        self._along = vehicle.length_m * torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0], device=others.device)
        self._radius_m = math.hypot(vehicle.length_m, vehicle.width_m) / 2

    def touches(self, vehicles: VehicleState) -> Tensor:
        """[E, V] bool: the footprint touches another vehicle, a parked car or a kerb."""
        boxes = self._footprints(vehicles)
        own = _fields(boxes, lambda field: field[..., None])
        others = _fields(boxes, lambda field: field[:, self._others])
        hits_parked = (overlap_depth(own, self.road.parked_boxes()) > 0).any(-1)
        return (overlap_depth(own, others) > 0).any(-1) | hits_parked | self.road.is_off_road(boxes)

    def first_contact(self, before: VehicleState, after: VehicleState) -> Tensor:
        """[E, V] float32: share of the control step from `before` to `after` at which a vehicle touches something.

        It is 1 for a vehicle in contact at the end of the step, whatever happened before, and inf without a contact.
        """
        poses = self._interpolate(before, after)
        contact = torch.minimum(self._hit(poses), self._off_road(poses))
        return torch.where(self.touches(after), 1.0, contact)

    def moved_until(self, share: Tensor, before: VehicleState, after: VehicleState) -> VehicleState:
        """The state `after` [E, V]; where `share` [E, V] is below 1, the state at that share of the step instead."""
        poses = self._interpolate(before, after, share[..., None].clamp(max=1.0))
        speed = before.speed + (after.speed - before.speed) * share
        stopped = replace(
            after, position=torch.cat([poses.x, poses.y], -1), yaw=wrap_angle(poses.yaw[..., 0]), speed=speed
        )
        return tree_where(share < 1, stopped, after)

    def stands_on_route(self, vehicles: VehicleState, direction: Tensor) -> Tensor:
        """[E, S] bool: a vehicle that follows its route in `direction` [E, 1] cannot pass `vehicles` [E, S]."""
        s = self.road.progress(vehicles.position, direction)[..., None] + self._along  # [E, S, K]
        direction = direction[..., None]
        zero = torch.zeros_like(s)
        passing = self.road.to_world(RouteState(s, zero, zero, *self.road.route_offset(s, direction)), direction)
        route = self._footprints(passing)
        route = route._replace(half_width=route.half_width + PASSING_M)
        standing = _fields(self._footprints(vehicles), lambda field: field[..., None])
        return (overlap_depth(route, standing) > 0).any(-1)

    def _interpolate(self, before: VehicleState, after: VehicleState, share: Tensor | None = None) -> _Poses:
        """Poses at the shares [..., K] of the step; None = at the ends of its pieces.

        The positions lie on a cubic Hermite curve. One whose end tangents are no longer than three times its chord
        moves forward all along (Fritsch & Carlson 1980).
        """
        t = self._share if share is None else share
        limit = 3 * (after.position - before.position).norm(dim=-1)
        start_tangent, end_tangent = _tangent(before, self.dt_s, limit), _tangent(after, self.dt_s, limit)
        h01, h10, h11 = t * t * (3 - 2 * t), t * (1 - t) * (1 - t), t * t * (t - 1)  # the Hermite basis
        start, end = before.position[..., None], after.position[..., None]
        place = start + h01[..., None, :] * (end - start)
        place = place + h10[..., None, :] * start_tangent[..., None] + h11[..., None, :] * end_tangent[..., None]
        yaw = before.yaw[..., None] + t * wrap_angle(after.yaw - before.yaw)[..., None]
        return _Poses(place[..., 0, :], place[..., 1, :], yaw)

    def _hit(self, poses: _Poses) -> Tensor:
        """[E, V] share of the step at which a vehicle hits another or a parked car; inf where it never does."""
        turn = poses.yaw.diff(dim=-1)  # [E, V, N]
        graze = GRAZE_M + self._radius_m * turn.abs() / 2
        boxes = self._boxes(poses.x[..., :-1], poses.y[..., :-1], poses.yaw[..., :-1] + turn / 2)
        boxes = boxes._replace(half_length=boxes.half_length - graze, half_width=boxes.half_width - graze)
        step = torch.stack([poses.x.diff(dim=-1), poses.y.diff(dim=-1)], -1)  # [E, V, N, 2]
        own = _fields(boxes, lambda field: field[..., None])  # [E, V, N, 1]
        others = _fields(boxes, lambda field: field[:, self._others].transpose(2, 3))  # [E, V, N, O]
        closing = step[:, self._others].transpose(2, 3) - step[..., None, :]
        with_others = time_to_collision(own, others, closing)
        with_parked = time_to_collision(own, self.road.parked_boxes(), -step[..., None, :])
        within = torch.cat([with_others, with_parked], -1).amin(-1)  # of a piece
        piece = torch.arange(self._n_pieces, device=within.device)
        return torch.where(within < 1, (piece + within) / self._n_pieces, torch.inf).amin(-1)

    def _off_road(self, poses: _Poses) -> Tensor:
        """[E, V] share of the step at the end of the first piece that ends off the road; inf where none does."""
        is_off = self.road.is_off_road(self._boxes(poses.x, poses.y, poses.yaw))
        return torch.where(is_off, self._share, torch.inf).amin(-1)

    def _footprints(self, vehicles: VehicleState) -> Boxes:
        x, y = vehicles.position.unbind(-1)
        return self._boxes(x, y, vehicles.yaw)

    def _boxes(self, x: Tensor, y: Tensor, yaw: Tensor) -> Boxes:
        return boxes_from_pose(x, y, yaw, self.vehicle.length_m, self.vehicle.width_m)


def _tangent(state: VehicleState, duration_s: float, limit_m: Tensor) -> Tensor:
    """[E, V, 2] m: displacement in `duration_s` at the present velocity, `limit_m` [E, V] at most."""
    distance = (state.speed * duration_s).minimum(limit_m)
    return torch.stack([distance * torch.cos(state.yaw), distance * torch.sin(state.yaw)], -1)


def _fields(boxes: Boxes, fn: Callable[[Tensor], Tensor]) -> Boxes:
    """Boxes with `fn` applied to every field that is a tensor."""
    return Boxes(*(fn(field) if isinstance(field, Tensor) else field for field in boxes))  # type: ignore[arg-type]
