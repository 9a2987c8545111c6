"""Lateral candidates: quintics over distance that shift the vehicle to an offset beside its route."""

from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from negopipe.planner.polynomial import evaluate, quintic
from negopipe.schema import PositiveMetres, Real, schema
from negopipe.simulation.road import Road, RouteState


@schema
class LateralConfig:
    """Lateral candidates: every offset with every length.

    offsets_m: end offsets from the route, positive to the left
    lengths_m: distances along the road over which the offset is reached
    """

    offsets_m: Annotated[list[Real], Field(min_length=1)]
    lengths_m: Annotated[list[PositiveMetres], Field(min_length=1)]

    @property
    def n_candidates(self) -> int:
        return len(self.offsets_m) * len(self.lengths_m)


class PathPoint(NamedTuple):
    """Points of paths in the route frame: offset d (m) and its derivatives d' (1) and d'' (1/m) by s; fields [...]."""

    d: Tensor
    d_prime: Tensor
    d_pprime: Tensor


class LateralCandidates:
    """Paths d(s) = route(s) + quintic(s): lateral motion over distance, independent of speed.

    Werling 2010 switches from d(t) to d(s) at low speed, and in a corridor of parked cars every speed is low. A path
    is checked once against curves, kerbs and parked cars, for all speeds at which it may be driven.
    """

    def __init__(self, config: LateralConfig, road: Road, device: torch.device | str = "cpu") -> None:
        self.road = road
        pairs = [(offset, length) for length in config.lengths_m for offset in config.offsets_m]
        self.n_candidates = config.n_candidates
        offsets, lengths = torch.tensor(pairs, device=device).T.contiguous()
        self.offset: Tensor = offsets[:, None]  # [L, 1] m
        self.length: Tensor = lengths  # [L] m
        maps = torch.stack([quintic(length) for _, length in pairs]).to(device, torch.float32)
        self._from_state = maps[:, :, :3].transpose(0, 1).flatten(0, 1).contiguous()  # [6 L, 3]: of d, d', d''
        self._from_target = (maps[:, :, 3] * offsets[:, None]).T[..., None].contiguous()  # [6, L, 1]

    def start(self, route: RouteState, direction: Tensor) -> tuple[Tensor, ...]:
        """Coefficients c_0 .. c_5, each [L, N], of the quintics that start at the states `route` (fields [N])."""
        d, d_prime, d_pprime = self.road.route_offset(route.s, direction)
        off_route = torch.stack([route.d - d, route.d_prime - d_prime, route.d_pprime - d_pprime])
        coefficients = (self._from_state @ off_route).reshape(6, self.n_candidates, -1) + self._from_target
        return coefficients.unbind(0)

    def follow(
        self, coefficients: tuple[Tensor, ...], start_s: Tensor, direction: Tensor, travelled: Tensor
    ) -> PathPoint:
        """Points of the paths at a distance along the road, fields [L, ..., N].

        coefficients: each [L, N], or with axes of length 1 between; start_s, direction: alike, m, +-1
        travelled: [..., N] m, the same for all paths
        """
        extra = travelled.dim() + 1 - coefficients[0].dim()
        columns = tuple(c.reshape(len(c), *[1] * extra, *c.shape[1:]) for c in coefficients)
        length = self.length.reshape(-1, *[1] * travelled.dim())
        d, d_prime, d_pprime = evaluate(columns, torch.minimum(travelled.clamp(min=0), length))
        route_d, route_d_prime, route_d_pprime = self.road.route_offset(start_s + travelled, direction)
        return PathPoint(route_d + d, route_d_prime + d_prime, route_d_pprime + d_pprime)


def path_shape(
    road: Road, s: Tensor, direction: Tensor, d: Tensor, d_prime: Tensor, d_pprime: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Curvature (1/m) of paths at some points, metres of path per metre of road (1), its derivative by s (1/m)."""
    if road.is_straight:
        path_per_road = torch.sqrt(1 + d_prime**2)
        return d_pprime / path_per_road**3, path_per_road, d_prime * d_pprime / path_per_road
    kappa, kappa_prime = road.curvature(s, direction)
    scale = 1 - kappa * d
    kappa_d_prime = kappa_prime * d + kappa * d_prime  # (kappa d)'
    path_per_road = torch.sqrt(scale**2 + d_prime**2)
    heading_prime = (scale * d_pprime + d_prime * kappa_d_prime) / path_per_road**2  # relative to the line
    path_per_road_prime = (d_prime * d_pprime - scale * kappa_d_prime) / path_per_road
    return (heading_prime + kappa) / path_per_road, path_per_road, path_per_road_prime
