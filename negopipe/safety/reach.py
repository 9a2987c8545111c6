"""Reachable sets: the places on their routes where other vehicles could be, by what they are assumed to do.

A vehicle drives along its route and returns to it from its offset. How far it has come at a time lies between that of
full braking and that of full acceleration. The road that it may cover is cut into K pieces. In each it is a straight
box, longer by the part of the piece that it may cover in a span of time. Other axes: C stops, J spans, O others, N
vehicles; N is the last axis.
"""

import torch
from torch import Tensor

from negopipe.planner.prediction import PredictedPath, along_routes
from negopipe.planner.situation import Others, Situation
from negopipe.safety.config import AssumedConfig, RssConfig
from negopipe.safety.stops import Sweep
from negopipe.simulation.geometry import Boxes, overlap_depth
from negopipe.simulation.road import Road

N_PIECES = 6
"""K, pieces of the road that another vehicle may cover."""

NEVER_M = 1e3
"""Margin to a vehicle that cannot be met, m."""


def farthest(assumed: AssumedConfig, speed: Tensor, time_s: Tensor | float) -> Tensor:
    """[...] m: largest distance covered by vehicles with speeds [...] (m/s) after `time_s` [...]."""
    gaining_s = ((assumed.speed_max_mps - speed) / assumed.accel_max_mps2).clamp(min=0)
    gained = torch.minimum(gaining_s, torch.as_tensor(time_s, dtype=speed.dtype, device=speed.device))
    return (speed * time_s + assumed.accel_max_mps2 * gained * (time_s - gained / 2)).clamp(min=0)


def nearest(assumed: AssumedConfig, speed: Tensor, time_s: Tensor) -> Tensor:
    """[...] m: smallest distance covered, by full braking; of a vehicle that drives backwards, by driving on so."""
    moving_s = torch.minimum(time_s, speed.clamp(min=0) / assumed.decel_max_mps2)
    forwards = speed * moving_s - assumed.decel_max_mps2 * moving_s**2 / 2
    return torch.where(speed < 0, speed * time_s, forwards)


def until_rest(assumed: AssumedConfig, speed: Tensor) -> Tensor:
    """[...] m: distance to rest of vehicles that accelerate until they respond and then brake with the least rate."""
    fastest = speed.clamp(min=assumed.speed_max_mps)
    then = torch.minimum(speed + assumed.accel_max_mps2 * assumed.response_s, fastest).clamp(min=0)
    return farthest(assumed, speed, assumed.response_s) + then**2 / (2 * assumed.braking_mps2)


class Reach:
    """Margins of the ego's stops to where the others could be."""

    def __init__(self, config: RssConfig, road: Road, dt_s: float) -> None:
        self.config, self.assumed, self.road, self._dt_s = config, config.others, road, dt_s

    def margin(self, now: Situation, swept: Sweep) -> Tensor:
        """[C, N] m: distance, in the sense of `overlap_depth`, of stops from all that the others could cover.

        swept: of stops that begin one control step after `now`
        """
        assumed, speed = self.assumed, now.others.route.s_dot
        ends_s = self._dt_s + swept.time_s[:, :, None]  # [C, J + 1, O, N], of the spans
        least, most = nearest(assumed, speed, ends_s[:, :-1]), farthest(assumed, speed, ends_s[:, 1:])
        at_rest = torch.maximum(most[:, -1:], until_rest(assumed, speed))
        most = torch.cat([most[:, :-1], at_rest], 1)  # who meets the ego at rest could have stopped before
        share = torch.linspace(0, 1, N_PIECES + 1, device=speed.device)[:, None, None]
        first, last = least.amin((0, 1)), most.amax((0, 1))
        edges = first + share * (last - first)  # [K + 1, O, N]
        middle = (edges[:-1] + edges[1:]) / 2
        places = along_routes(self.road, now.others, now.direction, middle.transpose(0, 1), assumed.offset_decay_m)
        begin = torch.maximum(least[:, :, None], edges[:-1])  # [C, J, K, O, N]
        end = torch.minimum(most[:, :, None], edges[1:])
        depth = self._depth(now, swept, places, (begin, end, middle))
        is_met = (end >= begin) & now.others.is_seen & ~_is_behind(now.others, now)
        return -torch.where(is_met, depth, -NEVER_M).amax((1, 2, 3))

    def _depth(
        self, now: Situation, swept: Sweep, places: PredictedPath, covered: tuple[Tensor, Tensor, Tensor]
    ) -> Tensor:
        """[C, J, K, O, N] m: depth by which the ego's box of a span reaches into the other's box of a piece.

        places: [O, K, N], of the pieces' middles
        covered: begin and end of what is covered of a piece, and its middle, all in distances travelled, m
        """
        begin, end, middle = covered
        place_s, place_d, place_tan = (field.transpose(0, 1) for field in places)  # [K, O, N]
        s, d, d_prime = (_middles(field)[:, :, None, None] for field in (swept.s, swept.d, swept.d_prime))
        longer = swept.s.diff(dim=1).abs()[:, :, None, None] / 2
        u, v, tan = self.road.in_tangent_frame(place_s, now.direction, s - place_s, d, d_prime)
        cos, other_cos = torch.rsqrt(1 + tan**2), torch.rsqrt(1 + place_tan**2)
        shift = torch.where(now.others.is_same, 1.0, -1.0) * ((begin + end) / 2 - middle)
        size, other, config = now.size, now.others.size, self.config
        own = Boxes(u, v, cos, tan * cos, size.length / 2 + longer / cos, size.width / 2)
        its = Boxes(
            shift,
            place_d + shift * place_tan,
            other_cos,
            place_tan * other_cos,
            other.length / 2 + config.ahead_m + (end - begin).clamp(min=0) / 2 / other_cos,
            other.width / 2 + config.beside_m,
        )
        return overlap_depth(own, its)


def _middles(field: Tensor) -> Tensor:
    """Means [C, J, N] of neighbours along the axis 1."""
    return (field[:, :-1] + field[:, 1:]) / 2


def _is_behind(others: Others, now: Situation) -> Tensor:
    """[O, N] bool: vehicles that follow one that does not drive backwards; keeping the distance is their matter."""
    return others.is_same & (others.s < now.route.s) & (now.route.s_dot >= 0)
