"""Reversing: who stands where an oncoming vehicle cannot pass drives back to the last place where it can.

Without it two vehicles that stand nose to nose stand there for ever. The way back is the own route, which a quintic
over distance leads to. It is driven at walking pace, and only where it is clear of kerbs, parked cars and other
vehicles. A vehicle reverses where its plan is to stay at rest, and only with a long prediction horizon: the horizon
still decides who gives in. Of two that reverse, the one with the longer way back stops.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.planner.lateral import path_shape
from negopipe.planner.polynomial import evaluate, quintic
from negopipe.planner.roadside import Roadside
from negopipe.schema import NonNegativeFloat, NonNegativeMetres, PositiveFloat, PositiveMetres, schema
from negopipe.simulation.collisions import CollisionCheck
from negopipe.simulation.road import RouteState
from negopipe.simulation.sizes import Sizes
from negopipe.simulation.state import VehicleState
from negopipe.simulation.waiting_place import Passage
from negopipe.tensors.tree import map_tensors

ROUNDING_M = 0.02
"""Distance by which a place may be missed, m."""
STILL_MPS = 1e-3
"""Speed below which a planned vehicle is at rest, m/s."""
CREEPING_MPS = 0.1
"""Speed backwards from which on a vehicle is seen to reverse, m/s."""


@schema
class ReversingConfig:
    """Limits of driving backwards.

    least_horizon_s: shortest prediction horizon with which a vehicle reverses
    speed_mps, accel_mps2: highest speed along the road and its rate of change
    length_m: longest way back
    beyond_m: distance behind the last place where the other can pass at which the way ends, so that it has more room
    return_m: distance over which the path leads back to the route
    behind_m: room to a vehicle behind at the end of the way
    """

    least_horizon_s: NonNegativeFloat
    speed_mps: PositiveFloat
    accel_mps2: PositiveFloat
    length_m: PositiveMetres
    beyond_m: NonNegativeMetres
    return_m: PositiveMetres
    behind_m: NonNegativeMetres


class Others(NamedTuple):
    """The other vehicles, fields [O, N]: where they are for the vehicle that plans.

    route: on their own routes
    is_oncoming: bool, seen and in the opposite direction
    s, offset: m, on the route of the vehicle that plans, and to the left of it
    is_seen: bool
    """

    route: RouteState
    is_oncoming: Tensor
    s: Tensor
    offset: Tensor
    is_seen: Tensor


class Reversing:
    """The way back of vehicles on one road; N vehicles that plan, O others."""

    def __init__(
        self,
        config: ReversingConfig,
        collisions: CollisionCheck,
        sizes: Sizes,
        passage: Passage,
        limits: tuple[float, float, float],
    ) -> None:
        """limits: clearance to what stands beside the road (m), sharpest curvature (1/m), spacing of checks (m)."""
        self.config, self.road, self.passage = config, collisions.road, passage
        self._collisions, self._sizes, self._dt_s = collisions, sizes, collisions.dt_s
        clearance_m, self._curvature_max, step_m = limits
        device = collisions.road.device
        self._behind = torch.arange(0.0, config.length_m + step_m, step_m, device=device)[:, None]  # [S, 1] m
        self._roadside = Roadside(self.road, sizes, torch.full_like(self._behind[:, 0], clearance_m))
        self._from_state = quintic(config.return_m)[:, :3].to(device, torch.float32)

    def plan(
        self,
        route: RouteState,
        direction: Tensor,
        horizon: Tensor,
        ahead: RouteState,
        others: Others,
    ) -> tuple[Tensor, RouteState]:
        """Who drives backwards or stops doing so [N] bool, and its state one step later; fields [N].

        ahead: state one step along the plan forwards
        """
        way = route.s - self.passage.waiting_s(route.s, direction) + self.config.beyond_m
        path = self._path(route, direction)
        stays = (route.s_dot.abs() <= STILL_MPS) & (ahead.s_dot.abs() <= STILL_MPS)
        is_asked = (horizon >= self.config.least_horizon_s) & self._is_in_the_way(route, direction, way, others)
        is_free = self._is_drivable(route, direction, way, path) & self._is_clear(route, way, others)
        goes = is_asked & is_free & (stays | (route.s_dot < 0)) & (way > ROUNDING_M) & (way <= self.config.length_m)
        return goes | (route.s_dot < 0), self._step(route, direction, torch.where(goes, way, 0.0), path)

    def others(self, other: VehicleState, direction: Tensor, is_seen: Tensor) -> Others:
        """The others [O, N] as the vehicles that drive in `direction` [N] see them."""
        its_direction = self.road.direction_of(other, direction)
        its = self.road.to_route(other, its_direction)
        is_same = its_direction == direction
        s = torch.where(is_same, its.s, self.road.corridor_m(direction) - its.s)
        d = torch.where(is_same, its.d, -its.d)
        offset = d - self.road.route_offset(s, direction)[0]
        return Others(its, is_seen & ~is_same, s, offset, is_seen)

    def _is_in_the_way(self, route: RouteState, direction: Tensor, way: Tensor, others: Others) -> Tensor:
        """[N] bool: an oncoming vehicle that has not passed cannot do so, and does not make way itself."""
        their_place = self.passage.at(self.passage.their_waiting, route.s, direction)
        its_way = others.route.s - their_place + self.config.beyond_m
        makes_way = (others.route.s_dot < -CREEPING_MPS) & (its_way < way)
        comes = others.is_oncoming & (others.s > route.s) & ~makes_way
        standing = map_tensors(lambda field: field[:, None], self.road.to_world(route, direction))
        return (
            comes.any(0)
            & self._collisions.stands_on_route(standing, self._sizes.ego, -direction[:, None], self._sizes.ego)[:, 0]
        )

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

    def _is_drivable(self, route: RouteState, direction: Tensor, way: Tensor, path: tuple[Tensor, ...]) -> Tensor:
        """[N] bool: the whole way is clear of kerbs and parked cars, and no bend is too sharp."""
        s, d, d_prime, d_pprime = self._at(route, direction, path, self._behind.expand(-1, len(way)))
        curvature, _, _ = path_shape(self.road, s, direction, d, d_prime, d_pprime)
        excess = self._roadside.excess(s, direction, d[None], d_prime[None])[0]
        excess = torch.maximum(excess, curvature.abs() - self._curvature_max)
        is_on_way = (self._behind > 0) & (self._behind < way + self._behind[1])
        return torch.where(is_on_way, excess, -1.0).amax(0) <= 0

    def _is_clear(self, route: RouteState, way: Tensor, others: Others) -> Tensor:
        """[N] bool: nobody behind is met, nor comes so near meanwhile."""
        config, size = self.config, self._sizes.ego
        duration_s = way.clamp(min=0) / config.speed_mps + config.speed_mps / config.accel_mps2
        speed = torch.where(others.is_oncoming, -others.route.s_dot, others.route.s_dot)
        gap = route.s - others.s - size.length - speed.clamp(min=0) * duration_s
        is_behind = others.is_seen & (others.s < route.s) & (others.offset.abs() < 1.5 * size.width)
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
