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
    """Every offset is combined with every length.

    offsets_m: end offsets from the route, positive to the left
    lengths_m: distances along the road over which the offset is reached
    """

    offsets_m: Annotated[list[Real], Field(min_length=1)]
    lengths_m: Annotated[list[PositiveMetres], Field(min_length=1)]

    @property
    def n_candidates(self) -> int:
        return len(self.offsets_m) * len(self.lengths_m)


class PathPoint(NamedTuple):
    """Points of paths in the route frame: offset d (m), slope d' and bend d'' (1/m) by s; every field [...]."""

    d: Tensor
    slope: Tensor
    bend: Tensor


class LateralCandidates:
    """Paths d(s) = route(s) + quintic(s): lateral motion over distance, so that it does not depend on speed.

    Werling 2010 switches from d(t) to d(s) at low speed; in a corridor of parked cars every speed is low. A path
    is checked against curves, kerbs and parked cars once, whatever the speed it is driven at.
    """

    def __init__(self, config: LateralConfig, road: Road, device: torch.device | str = "cpu") -> None:
        self.road = road
        pairs = [(offset, length) for length in config.lengths_m for offset in config.offsets_m]
        self.n_candidates = config.n_candidates
        offsets, lengths = torch.tensor(pairs, device=device).T.contiguous()
        self.offset: Tensor = offsets[:, None]  # [L, 1] m
        self._length = lengths  # [L] m
        maps = torch.stack([quintic(length) for _, length in pairs]).to(device, torch.float32)
        self._from_state = maps[:, :, :3].transpose(0, 1).flatten(0, 1).contiguous()  # [6 L, 3]: offset, slope, bend
        self._from_target = (maps[:, :, 3] * offsets[:, None]).T[..., None].contiguous()  # [6, L, 1]

    def start(self, route: RouteState, direction: Tensor) -> tuple[Tensor, ...]:
        """Coefficients c_0 .. c_5, each [L, N], of the quintics that start at the states `route` (fields [N])."""
        d, slope, bend = self.road.route_offset(route.s, direction)
        beside = torch.stack([route.d - d, route.d_prime - slope, route.d_pprime - bend])
        coefficients = (self._from_state @ beside).reshape(6, self.n_candidates, -1) + self._from_target
        return coefficients.unbind(0)

    def follow(
        self, coefficients: tuple[Tensor, ...], start_s: Tensor, direction: Tensor, travelled: Tensor
    ) -> PathPoint:
        """Points of the paths after some distance along the road, fields [L, ..., N].

        start_s, direction: [N] m, +-1; travelled: [..., N] m, the same for all paths
        """
        extra = travelled.dim() - 1
        columns = tuple(c.reshape(c.shape[0], *[1] * extra, c.shape[1]) for c in coefficients)
        length = self._length.reshape(-1, *[1] * travelled.dim())
        value, slope, bend = evaluate(columns, torch.minimum(travelled.clamp(min=0), length))
        route_d, route_slope, route_bend = self.road.route_offset(start_s + travelled, direction)
        return PathPoint(route_d + value, route_slope + slope, route_bend + bend)
