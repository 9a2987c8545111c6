"""Lateral candidates: quintics over distance that shift the vehicle to an offset beside its route."""

from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from negopipe.planner.polynomial import evaluate, quintic
from negopipe.schema import PositiveFloat, schema
from negopipe.simulation.road import Road, RouteState


@schema
class LateralConfig:
    """Every offset is combined with every length.

    offsets_m: end offsets from the route, positive to the left
    lengths_m: distances along the road over which the offset is reached
    """

    offsets_m: Annotated[list[float], Field(min_length=1)]
    lengths_m: Annotated[list[PositiveFloat], Field(min_length=1)]


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
        self.n_candidates = len(pairs)
        offsets, lengths = torch.tensor(pairs, device=device).T.contiguous()
        self.offset: Tensor = offsets  # [C] m
        self._length = lengths  # [C] m
        maps = torch.stack([quintic(length) for _, length in pairs]).to(device, torch.float32)
        self._from_state = maps[:, :, :3].contiguous()  # [C, 6, 3] of offset, slope, bend now
        self._from_target = maps[:, :, 3] * offsets[:, None]  # [C, 6]

    def start(self, route: RouteState, direction: Tensor) -> tuple[Tensor, ...]:
        """Coefficients c_0 .. c_5, each [N, C], of the quintics that start at the states `route` (fields [N]).

        direction: [N] float32, +1 or -1
        """
        d, slope, bend = self.road.route_offset(route.s, direction)
        beside = torch.stack([route.d - d, route.d_prime - slope, route.d_pprime - bend], dim=-1)
        coefficients = torch.einsum("cki,ni->nck", self._from_state, beside) + self._from_target
        return coefficients.unbind(-1)

    def follow(
        self, coefficients: tuple[Tensor, ...], start_s: Tensor, direction: Tensor, travelled: Tensor
    ) -> PathPoint:
        """Points after `travelled` [N, C, ...] (m, along the road) of the paths that start at `start_s` [N] (m).

        direction: [N] float32, +1 or -1
        """
        extra = travelled.dim() - 2
        columns = tuple(c.reshape(*c.shape, *[1] * extra) for c in coefficients)
        length = self._length.reshape(-1, *[1] * extra)
        value, slope, bend = evaluate(columns, torch.minimum(travelled.clamp(min=0), length))
        start_s, direction = (field.reshape(-1, *[1] * (extra + 1)) for field in (start_s, direction))
        route_d, route_slope, route_bend = self.road.route_offset(start_s + travelled, direction)
        return PathPoint(route_d + value, route_slope + slope, route_bend + bend)
