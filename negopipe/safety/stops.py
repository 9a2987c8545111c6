"""Stops: paths of the ego, and what is driven of them until it is at rest.

Axes: C stops, J spans of time of a stop, N vehicles. N is the last axis.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.planner.lateral import LateralCandidates, path_shape
from negopipe.planner.polynomial import N_COEFFICIENTS, evaluate
from negopipe.simulation.road import Road, RouteState

N_PATH = N_COEFFICIENTS + 2
"""Numbers of a path."""


class StopPaths(NamedTuple):
    """Paths d(s) = route(s) + quintic(s - start_s), straight on beside the route from `length` on.

    coefficients: six tensors [C, N]
    start_s: [C, N] m; length: [C, N] m, of the quintic
    """

    coefficients: tuple[Tensor, ...]
    start_s: Tensor
    length: Tensor

    @staticmethod
    def fresh(lateral: LateralCandidates, route: RouteState, direction: Tensor) -> "StopPaths":
        """The candidates from states `route` [N]; direction: [N]."""
        coefficients = lateral.start(route, direction)
        shape = coefficients[0].shape
        return StopPaths(coefficients, route.s.expand(shape), lateral.length[:, None].expand(shape))

    @staticmethod
    def unpack(kept: Tensor) -> "StopPaths":
        """The path [1, N] of a tensor [N, N_PATH]."""
        *coefficients, start_s, length = kept.T[:, None].unbind(0)
        return StopPaths(tuple(coefficients), start_s, length)

    def pack(self) -> Tensor:
        """The tensor [C, N, N_PATH] of the paths."""
        return torch.stack([*self.coefficients, self.start_s, self.length], -1)

    def joined(self, *more: "StopPaths") -> "StopPaths":
        """All paths, one after the other along C."""
        parts = [torch.cat(fields) for fields in zip(*(_fields(each) for each in (self, *more)), strict=True)]
        return StopPaths(tuple(parts[:-2]), *parts[-2:])

    def at(self, road: Road, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """d (m), d' (1) and d'' (1/m) at places s [C, N] or [C, J, N] (m)."""
        extra = s.dim() - self.start_s.dim()
        columns = [_spread(field, extra) for field in _fields(self)]
        *coefficients, start_s, length = columns
        d, d_prime, d_pprime = evaluate(tuple(coefficients), torch.minimum((s - start_s).clamp(min=0), length))
        route_d, route_d_prime, route_d_pprime = road.route_offset(s, direction)
        return route_d + d, route_d_prime + d_prime, route_d_pprime + d_pprime


def braked(
    road: Road, direction: Tensor, now: RouteState, paths: StopPaths, decel: Tensor, time_s: float | Tensor
) -> RouteState:
    """States [C, N] some time into braking along the paths.

    now: fields [N]; decel: [C, N] m/s2, along the path; time_s: one or [C, 1]
    """
    per_road = _per_road(road, direction, now)
    decel, gear, speed = decel / per_road, torch.sign(now.s_dot), now.s_dot.abs()
    moving_s = (speed / decel).clamp(max=time_s)
    travelled = speed * moving_s - decel * moving_s**2 / 2
    after = (speed - decel * time_s).clamp(min=0)
    s = now.s + gear * travelled
    return RouteState(s, gear * after, torch.where(after > 0, -gear * decel, 0.0), *paths.at(road, direction, s))


class Sweep(NamedTuple):
    """What vehicles drive of their stops, at the J + 1 ends of J spans of equal time; fields [C, J + 1, N].

    time_s: since the stop began
    s, d, d_prime: m, m and 1; curvature: 1/m
    """

    time_s: Tensor
    s: Tensor
    d: Tensor
    d_prime: Tensor
    curvature: Tensor


def sweep(road: Road, direction: Tensor, start: RouteState, paths: StopPaths, decel_mps2: float, n_spans: int) -> Sweep:
    """From states [C, N] along the paths to rest."""
    decel, gear, speed = decel_mps2 / _per_road(road, direction, start), torch.sign(start.s_dot), start.s_dot.abs()
    share = torch.linspace(0, 1, n_spans + 1, device=speed.device)[:, None]
    time = (speed / decel)[:, None] * share  # [C, J + 1, N]
    s = start.s[:, None] + gear[:, None] * (speed[:, None] * time - decel[:, None] * time**2 / 2)
    d, d_prime, d_pprime = paths.at(road, direction, s)
    return Sweep(time, s, d, d_prime, path_shape(road, s, direction, d, d_prime, d_pprime)[0])


def _per_road(road: Road, direction: Tensor, route: RouteState) -> Tensor:
    """Metres of path per metre of road."""
    return path_shape(road, route.s, direction, route.d, route.d_prime, route.d_pprime)[1]


def _fields(paths: StopPaths) -> list[Tensor]:
    return [*paths.coefficients, paths.start_s, paths.length]


def _spread(field: Tensor, extra: int) -> Tensor:
    """[C, N] with `extra` axes between."""
    return field.reshape(field.shape[0], *[1] * extra, field.shape[1])
