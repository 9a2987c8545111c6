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

from negopipe.simulation.geometry import (
    Boxes,
    Size,
    boxes_from_pose,
    half_diagonal,
    overlap_depth,
    time_to_collision,
    wrap_angle,
)
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.state import VehicleState
from negopipe.tensors.materialize import materialize
from negopipe.tensors.tree import tree_where

PIECE_S = 0.05
"""Longest piece of a motion between two control steps, s."""

KERB_PIECE_S = 0.1
"""Longest time between two checks against the kerbs, s: at 8 m/s2 a motion leaves its chord by 1 cm in that time."""

GRAZE_M = 0.01
"""Depth of an overlap that counts as a graze, m: at 8 m/s2 the line of a piece and the cubic are half as far apart."""

PASSING_M = 0.3
"""Least room on either side of a vehicle that passes another, m."""


class _Poses(NamedTuple):
    """Poses of V vehicles in E worlds and their speeds, fields [..., V, E], m, rad and m/s, world frame.

    E is the last axis, so that computations per world run on vector units.
    """

    x: Tensor
    y: Tensor
    yaw: Tensor
    speed: Tensor


class CollisionCheck:
    """Checks the true oriented footprints of V vehicles against each other, parked cars and kerbs.

    others: [V, V - 1] int64, for each vehicle the columns of all others
    size, in every method: of the vehicles, [E, V] or floats
    """

    def __init__(self, road: Road, dt_s: float, others: Tensor) -> None:
        self.road, self.dt_s = road, dt_s
        self._others = others
        self._n_pieces = math.ceil(dt_s / PIECE_S - 1e-9)
        self._share = torch.linspace(0, 1, self._n_pieces + 1, device=others.device)[:, None, None]
        n_kerb = math.ceil(dt_s / KERB_PIECE_S - 1e-9)
        self._kerb_share = torch.linspace(0, 1, n_kerb + 1, device=others.device)[1:-1, None, None]
        self._along = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0], device=others.device)

    def touches(self, vehicles: VehicleState, direction: Tensor, size: Size) -> Tensor:
        """[E, V] bool: the footprint touches another vehicle, a parked car or a kerb; direction: [E, V]."""
        (poses,) = _worlds_last(vehicles)
        boxes = boxes_from_pose(poses.x, poses.y, poses.yaw, *_turned(size))
        is_off_road = self.road.is_off_road(boxes, direction.T)
        return (self._overlaps(boxes, direction.T) | is_off_road).transpose(0, 1)

    def first_contact(self, before: VehicleState, after: VehicleState, direction: Tensor, size: Size) -> Tensor:
        """[E, V] float32: share of the control step from `before` to `after` at which a vehicle touches something.

        It is 1 for a vehicle in contact at the end of the step, whatever happened before, and inf without a contact.

        direction: [E, V]
        """
        start, end = _worlds_last(before, after)
        way, size = direction.T, _turned(size)
        hit = self._hit(self._interpolate(start, end, self._share), way, size)
        is_off_road = self._is_off_road(start, end, way, size)
        left_road = torch.where(is_off_road[:-1], self._kerb_share, torch.inf)
        contact = torch.cat([left_road, hit[None]]).amin(0)
        boxes = boxes_from_pose(end.x, end.y, end.yaw, *size)
        return torch.where(self._overlaps(boxes, way) | is_off_road[-1], 1.0, contact).transpose(0, 1)

    def moved_until(self, share: Tensor, before: VehicleState, after: VehicleState) -> VehicleState:
        """The state `after` [E, V]; where `share` [E, V] is below 1, the state at that share of the step instead."""
        start, end = _worlds_last(before, after)
        poses = self._interpolate(start, end, share.transpose(0, 1).clamp(max=1.0))
        x, y, yaw, speed = (field.transpose(0, 1) for field in poses)
        stopped = replace(after, position=torch.stack([x, y], -1), yaw=wrap_angle(yaw), speed=speed)
        return tree_where(share < 1, stopped, after)

    def stands_on_route(
        self, vehicles: VehicleState, size: Size, direction: Tensor, passing: Size, room_m: float
    ) -> Tensor:
        """[E, S] bool: a vehicle that follows its route in `direction` [E, 1] cannot pass `vehicles` [E, S].

        size, passing: of the vehicles and of the one that passes, [E, S] or [E, 1], or floats
        room_m: that it needs on either side
        """
        size, passing = _each(size), _each(passing)
        along = (size.length + passing.length) / 2 * self._along  # of all places at which the two can touch
        s = self.road.progress(vehicles.position, direction)[..., None] + along  # [E, S, K]
        direction = direction[..., None]
        zero = torch.zeros_like(s)
        on_route = self.road.to_world(RouteState(s, zero, zero, *self.road.route_offset(s, direction)), direction)
        route = boxes_from_pose(on_route.position[..., 0], on_route.position[..., 1], on_route.yaw, *passing)
        route = route._replace(half_width=route.half_width + room_m)
        x, y, yaw = (field[..., None] for field in (*vehicles.position.unbind(-1), vehicles.yaw))
        standing = boxes_from_pose(x, y, yaw, *size)
        return (overlap_depth(route, standing) > 0).any(-1)

    def _interpolate(self, start: _Poses, end: _Poses, share: Tensor) -> _Poses:
        """Poses at the shares [..., V, E] of the step between poses [V, E].

        The positions lie on a cubic Hermite curve. One whose end tangents are no longer than three times its chord
        moves forward all along (Fritsch & Carlson 1980).
        """
        t = share
        limit = 3 * torch.sqrt((end.x - start.x) ** 2 + (end.y - start.y) ** 2)
        (start_x, start_y), (end_x, end_y) = (_tangent(poses, self.dt_s, limit) for poses in (start, end))
        h01, h10, h11 = t * t * (3 - 2 * t), t * (1 - t) * (1 - t), t * t * (t - 1)  # the Hermite basis
        return _Poses(
            start.x + h01 * (end.x - start.x) + h10 * start_x + h11 * end_x,
            start.y + h01 * (end.y - start.y) + h10 * start_y + h11 * end_y,
            start.yaw + t * wrap_angle(end.yaw - start.yaw),
            start.speed + t * (end.speed - start.speed),
        )

    def _overlaps(self, boxes: Boxes, direction: Tensor) -> Tensor:
        """[V, E] bool: the footprint touches another vehicle or a parked car; boxes: fields [V, E]."""
        own = _fields(boxes, lambda field: field[:, None])  # [V, 1, E]
        others = _fields(boxes, lambda field: field[self._others])  # [V, O, E]
        with_others, with_parked = overlap_depth(own, others), overlap_depth(own, self._parked(direction))
        return torch.cat([with_others, with_parked], 1).amax(1) > 0

    def _hit(self, poses: _Poses, direction: Tensor, size: Size) -> Tensor:
        """[V, E] share of the step at which a vehicle hits another or a parked car; inf where it never does."""
        turn = poses.yaw.diff(dim=0)  # [N, V, E]
        graze = GRAZE_M + half_diagonal(size) * turn.abs() / 2
        boxes = boxes_from_pose(poses.x[:-1], poses.y[:-1], poses.yaw[:-1] + turn / 2, *size)
        boxes = boxes._replace(half_length=boxes.half_length - graze, half_width=boxes.half_width - graze)
        step_x, step_y = poses.x.diff(dim=0), poses.y.diff(dim=0)
        own = _fields(boxes, lambda field: field[:, :, None])  # [N, V, 1, E]
        others = _fields(boxes, lambda field: field[:, self._others])  # [N, V, O, E]
        closing = (step[:, self._others] - step[:, :, None] for step in (step_x, step_y))
        with_others = time_to_collision(own, others, *closing)
        with_parked = time_to_collision(own, self._parked(direction), -step_x[:, :, None], -step_y[:, :, None])
        within = torch.minimum(with_others.amin(2), with_parked.amin(2))  # of a piece
        piece = torch.arange(self._n_pieces, device=within.device)[:, None, None]
        return torch.where(within < 1, (piece + within) / self._n_pieces, torch.inf).amin(0)

    def _is_off_road(self, start: _Poses, end: _Poses, direction: Tensor, size: Size) -> Tensor:
        """[N, V, E] bool: the footprint reaches over a kerb at the ends of pieces, the last of which is the step's."""
        between = self._interpolate(start, end, self._kerb_share)
        x, y, yaw = (torch.cat([a, b[None]]) for a, b in zip(between[:3], end[:3], strict=True))
        return self.road.is_off_road(boxes_from_pose(x, y, yaw, *size), direction)

    def _parked(self, direction: Tensor) -> Boxes:
        """Parked cars, fields [P, E] or, of one street, [P, 1]; direction: [V, E]."""
        return _fields(self.road.parked_boxes(direction[0]), lambda field: torch.atleast_2d(field).T)


def _turned(size: Size) -> Size:
    """Sizes [V, E] from those [E, V]."""
    return Size(*(field.T if isinstance(field, Tensor) else field for field in size))


def _each(size: Size) -> Size:
    """Sizes with an axis for the places at which each vehicle is compared."""
    return Size(*(field[..., None] if isinstance(field, Tensor) else field for field in size))


def _worlds_last(*states: VehicleState) -> list[_Poses]:
    """The states [E, V] with E as the last axis."""
    fields = [(*state.position.unbind(-1), state.yaw, state.speed) for state in states]
    rows = materialize(*(field.transpose(0, 1) for state in fields for field in state))
    return [_Poses(*rows[i : i + 4]) for i in range(0, len(rows), 4)]


def _tangent(poses: _Poses, duration_s: float, limit_m: Tensor) -> tuple[Tensor, Tensor]:
    """x and y [V, E] of the displacement in `duration_s` at the present velocity, `limit_m` [V, E] at most; m."""
    distance = (poses.speed * duration_s).clamp(-limit_m, limit_m)
    return distance * torch.cos(poses.yaw), distance * torch.sin(poses.yaw)


def _fields(boxes: Boxes, fn: Callable[[Tensor], Tensor]) -> Boxes:
    """Boxes with `fn` applied to every field that is a tensor."""
    return Boxes(*(fn(field) if isinstance(field, Tensor) else field for field in boxes))  # type: ignore[arg-type]
