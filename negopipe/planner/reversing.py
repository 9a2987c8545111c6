"""Reversing: who stands where an oncoming vehicle cannot pass drives back to the last place where it can.

Without it two vehicles that stand nose to nose stand there for ever. The way back is the own route, which a quintic
over distance leads to. It is driven at walking pace, and only where it is clear of kerbs, parked cars and other
vehicles. A vehicle reverses where its plan is to stay at rest, and only with a long prediction horizon: the horizon
still decides who gives in. Of two that reverse, the one with the longer way back stops.
"""

import torch
from torch import Tensor

from negopipe.planner.lateral import path_shape
from negopipe.planner.making_room import way_for_those_ahead
from negopipe.planner.polynomial import evaluate, quintic
from negopipe.planner.roadside import Roadside
from negopipe.planner.situation import Others, Situation
from negopipe.schema import NonNegativeFloat, NonNegativeMetres, PositiveFloat, PositiveMetres, schema
from negopipe.simulation.collisions import PASSING_M, CollisionCheck
from negopipe.simulation.geometry import Size
from negopipe.simulation.road import RouteState
from negopipe.simulation.waiting_place import Passage
from negopipe.tensors.tree import map_tensors

ROUNDING_M = 0.02
"""Distance by which a place may be missed, m."""
STILL_MPS = 1e-3
"""Speed below which a planned vehicle is at rest, m/s."""
CREEPING_MPS = 0.1
"""Speed backwards from which on a vehicle is seen to reverse, m/s."""
SPARE_M = 0.5
"""More room than the vehicle ahead needs, m, so that it sets off before the one behind has stopped."""
WAITING_M = 1.0
"""Who has made room, and so much more at most, stays there until the vehicle ahead has used it, m."""


@schema
class ReversingConfig:
    """Limits of driving backwards.

    least_horizon_s: shortest prediction horizon with which a vehicle reverses
    speed_mps, accel_mps2: highest speed along the road and its rate of change
    length_m: longest way back
    beyond_m: distance behind the last place where the other can pass at which the way ends, so that it has more room
    return_m: distance over which the path leads back to the route
    behind_m: room to a vehicle behind at the end of the way
    makes_room: whether a vehicle also drives back so that the one ahead of it can (`negopipe.planner.making_room`)
    """

    least_horizon_s: NonNegativeFloat
    speed_mps: PositiveFloat
    accel_mps2: PositiveFloat
    length_m: PositiveMetres
    beyond_m: NonNegativeMetres
    return_m: PositiveMetres
    behind_m: NonNegativeMetres
    makes_room: bool


class Reversing:
    """The way back of vehicles on one road; N vehicles that plan, O others."""

    def __init__(
        self, config: ReversingConfig, collisions: CollisionCheck, passage: Passage, limits: tuple[float, float, float]
    ) -> None:
        """limits: clearance to what stands beside the road (m), sharpest curvature (1/m), spacing of checks (m)."""
        self.config, self.road, self.passage = config, collisions.road, passage
        self._collisions, self._dt_s = collisions, collisions.dt_s
        clearance_m, self._curvature_max, step_m = limits
        self._halting_m = config.speed_mps * self._dt_s + config.speed_mps**2 / (2 * config.accel_mps2)
        device = collisions.road.device
        self._behind = torch.arange(0.0, config.length_m + step_m, step_m, device=device)[:, None]  # [S, 1] m
        self._roadside = Roadside(self.road, passage.sizes, torch.full_like(self._behind[:, 0], clearance_m))
        self._from_state = quintic(config.return_m)[:, :3].to(device, torch.float32)

    def plan(self, now: Situation, ahead: RouteState) -> tuple[Tensor, RouteState]:
        """Who drives backwards, stops doing so, or waits for one that does [N] bool; its state one step later [N].

        ahead: state one step along the plan forwards
        """
        route, direction, horizon = now.route, now.direction, now.horizon
        way = route.s - self.passage.waiting_s(route.s, direction, now.size.length) + self.config.beyond_m
        path, room = self._path(route, direction), self._room(now)
        is_at_rest = route.s_dot.abs() <= STILL_MPS
        stays = is_at_rest & (ahead.s_dot.abs() <= STILL_MPS)
        is_asked = (
            (horizon >= self.config.least_horizon_s) & self._is_in_the_way(now, way) & (stays | (route.s_dot < 0))
        )
        way = torch.maximum(torch.where(is_asked, way, -torch.inf), room)
        is_free = self._is_drivable(now, way, path) & self._is_clear(now, way)
        goes = is_free & (is_at_rest | (route.s_dot < 0)) & (way > ROUNDING_M) & (way <= self.config.length_m)
        waits = is_at_rest & (room > -WAITING_M)
        return goes | waits | (route.s_dot < 0), self._step(route, direction, torch.where(goes, way, 0.0), path)

    def _room(self, now: Situation) -> Tensor:
        """[N] m: distance to drive back for the vehicles ahead, -inf where none asks."""
        if not self.config.makes_room:
            return torch.full_like(now.route.s, -torch.inf)
        return way_for_those_ahead(self.passage, now, self.config.beyond_m, self.config.behind_m + SPARE_M)

    def to_rest(self, now: Situation, back: RouteState, times: Tensor) -> RouteState:
        """States [T, N] at `times` [T] (s): `back` [N] at the first of them, then coming to rest."""
        route, direction, accel = now.route, now.direction, self.config.accel_mps2
        speed = (-back.s_dot).clamp(min=0)
        moving_s = torch.minimum((times[1:] - times[0])[:, None], speed / accel)
        driven = route.s - back.s + moving_s * (speed - accel * moving_s / 2)
        s, d, d_prime, d_pprime = self._at(route, direction, self._path(route, direction), driven)
        left = speed - accel * moving_s
        later = RouteState(s, -left, torch.where(left > 0, accel, 0.0), d, d_prime, d_pprime)
        return RouteState(*(torch.cat([first[None], rest]) for first, rest in zip(back, later, strict=True)))

    def _is_in_the_way(self, now: Situation, way: Tensor) -> Tensor:
        """[N] bool: an oncoming vehicle that has not passed cannot do so, and does not make way itself."""
        route, direction, others = now.route, now.direction, now.others
        their_place = self.passage.their_waiting_s(route.s, direction, others.size.length)
        its_way = others.route.s - their_place + self.config.beyond_m
        makes_way = (others.route.s_dot < -CREEPING_MPS) & (its_way < way)
        comes = others.is_oncoming & (others.s > route.s) & ~makes_way
        standing = map_tensors(lambda field: field[:, None], self.road.to_world(route, direction))
        stands = self._collisions.stands_on_route(
            standing, _column(now.size), -direction[:, None], _largest(others, comes), PASSING_M
        )
        return comes.any(0) & stands[:, 0]

    def _path(self, route: RouteState, direction: Tensor) -> tuple[Tensor, ...]:
        """Coefficients c_0 .. c_5 [N] of the offset from the route over the distance driven backwards."""
        d, d_prime, d_pprime = self.road.route_offset(route.s, direction)
        off_route = torch.stack([route.d - d, d_prime - route.d_prime, route.d_pprime - d_pprime])
        return (self._from_state @ off_route).unbind(0)

    def _at(
        self, route: RouteState, direction: Tensor, path: tuple[Tensor, ...], back: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """s, d, d' and d'' [..., N] of the paths, `back` [..., N] m behind the vehicles."""
        s = route.s - back
        offset, offset_prime, offset_pprime = evaluate(path, back.clamp(max=self.config.return_m))
        d, d_prime, d_pprime = self.road.route_offset(s, direction)
        return s, d + offset, d_prime - offset_prime, d_pprime + offset_pprime

    def _is_drivable(self, now: Situation, way: Tensor, path: tuple[Tensor, ...]) -> Tensor:
        """[N] bool: the whole way is clear of kerbs and parked cars, and no bend is too sharp."""
        route, direction = now.route, now.direction
        s, d, d_prime, d_pprime = self._at(route, direction, path, self._behind.expand(-1, len(way)))
        curvature, _, _ = path_shape(self.road, s, direction, d, d_prime, d_pprime)
        excess = self._roadside.excess(s, direction, d[None], d_prime[None], now.size)[0]
        excess = torch.maximum(excess, curvature.abs() - self._curvature_max)
        is_on_way = (self._behind > 0) & (self._behind < way + self._behind[1])
        return torch.where(is_on_way, excess, -1.0).amax(0) <= 0

    def _is_clear(self, now: Situation, way: Tensor) -> Tensor:
        """[N] bool: nobody behind is met, nor comes so near meanwhile."""
        route, direction, others = now.route, now.direction, now.others
        config, size, other = self.config, now.size, others.size
        duration_s = way.clamp(min=0) / config.speed_mps + config.speed_mps / config.accel_mps2
        speed = torch.where(others.is_same, others.route.s_dot, -others.route.s_dot)
        gap = route.s - others.s - (size.length + other.length) / 2 - speed.clamp(min=0) * duration_s
        offset = others.d - self.road.route_offset(others.s, direction)[0]
        is_behind = others.is_seen & (others.s < route.s) & (offset.abs() < 0.75 * (size.width + other.width))
        if config.makes_room:  # who drives back itself leaves more room with every step
            way = torch.where(speed < -CREEPING_MPS, way.clamp(max=self._halting_m), way)
        return ~(is_behind & (gap < way + config.behind_m)).any(0)

    def _step(self, route: RouteState, direction: Tensor, way: Tensor, path: tuple[Tensor, ...]) -> RouteState:
        """State one step later, on the way to a halt after `way` [N] (m) of road, or as soon as the brakes allow."""
        config, dt = self.config, self._dt_s
        speed, change = (-route.s_dot).clamp(min=0), config.accel_mps2 * dt
        left = (way - speed * dt / 2).clamp(min=0)
        fastest = torch.sqrt((change / 2) ** 2 + 2 * config.accel_mps2 * left) - change / 2
        after = torch.minimum(fastest.clamp(max=config.speed_mps), speed + change)
        after = torch.maximum(after, (speed - change).clamp(min=0))
        after = torch.where(after < STILL_MPS, 0.0, after)
        halting = speed**2 / (2 * config.accel_mps2)  # m, of who comes to rest within the step
        back = torch.where((after == 0) & (speed < change), halting, (speed + after) / 2 * dt)
        s, d, d_prime, d_pprime = self._at(route, direction, path, back)
        return RouteState(s, -after, torch.where(after > 0, (speed - after) / dt, 0.0), d, d_prime, d_pprime)


def _column(size: Size) -> Size:
    """Sizes [N, 1] of vehicles [N]."""
    return Size(*(field[:, None] if isinstance(field, Tensor) else field for field in size))


def _largest(others: Others, comes: Tensor) -> Size:
    """Sizes [N, 1] that bound those of the others that come [O, N]."""
    return Size(*(torch.where(comes, f, 0.0).amax(0)[:, None] if isinstance(f, Tensor) else f for f in others.size))
