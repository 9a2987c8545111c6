"""The planner: sample, check, cost, choose (Werling 2010; problem (1) of the paper).

Axes here: N vehicles that plan (worlds and agents flattened), O others that each perceives, C longitudinal and
L lateral candidates, T times, P parked cars, S stations along a path, K stations around a predicted vehicle. N is the
last axis of every tensor, so that computations per vehicle run on vector units and no axis has to be moved.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.planner.braking import BrakingCandidates, BrakingSamples
from negopipe.planner.config import ClearanceConfig, PlannerConfig
from negopipe.planner.following import predicted_s
from negopipe.planner.give_way import GiveWay
from negopipe.planner.lateral import LateralCandidates, path_shape
from negopipe.planner.lingering import Lingering
from negopipe.planner.longitudinal import LongitudinalCandidates, LongitudinalSamples
from negopipe.planner.prediction import PredictedPath, predict
from negopipe.planner.reversing import Reversing
from negopipe.planner.roadside import Roadside
from negopipe.simulation.collisions import CollisionCheck
from negopipe.simulation.geometry import Boxes, Size, overlap_depth
from negopipe.simulation.perception import Perception, other_columns
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.sizes import Sizes
from negopipe.simulation.state import AT_REST_MPS, Motion, VehicleState
from negopipe.simulation.waiting_place import Passage
from negopipe.tensors.materialize import materialize
from negopipe.tensors.tree import map_tensors

STANDING_M = 1e-3
"""Distance that a vehicle which stands may travel by its plan, m: rounding."""


class Paths(NamedTuple):
    """Lateral candidates that start at the present states.

    coefficients: six tensors [L, N] of the quintics
    free_distance: [L, N] m, drivable distance along the road: up to the first point at which the path is too sharp or
        too close to a kerb or a parked car
    path_per_road: [L, N] 1, largest ratio of a metre of path to a metre of road
    path_per_road_prime: [L, N] 1/m, largest magnitude of its derivative by s: at a constant speed along the road, the
        acceleration along the path is at most this times the square of that speed
    cost: [L, N]
    """

    coefficients: tuple[Tensor, ...]
    free_distance: Tensor
    path_per_road: Tensor
    path_per_road_prime: Tensor
    cost: Tensor


class FrenetPlanner:
    """Planner of any number of vehicles in one call; they differ in state and prediction horizon only."""

    def __init__(
        self,
        config: PlannerConfig,
        road: Road,
        sizes: Sizes,
        dt_s: float,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config, self.road, self.sizes, self.dt_s = config, road, sizes, dt_s
        self.times = torch.arange(1, config.n_times(dt_s) + 1, device=device) * dt_s
        self.longitudinal = LongitudinalCandidates(config.longitudinal, self.times)
        self.braking = BrakingCandidates(config.braking, self.times)
        self.lateral = LateralCandidates(config.lateral, road, device)
        self.stations = torch.arange(1, config.n_stations + 1, device=device) * config.clearance.station_m
        self.roadside = Roadside(road, sizes, _parked_clearance(config.clearance, self.stations))
        self.give_way, self.reversing, self.lingering = self._rules(device)
        self._slacks_m = (0.0, config.braking.slack_m) if config.braking.n_candidates else (0.0,)
        self._around = _stations_around(config, sizes.largest).to(device)  # [K] m

    def _rules(self, device: torch.device | str) -> tuple[GiveWay | None, Reversing | None, Lingering | None]:
        """The rules at a passage; None where the planner has none."""
        config = self.config
        if config.give_way is None and config.reversing is None and not config.cost.lingering:
            return None, None, None
        collisions = CollisionCheck(self.road, self.dt_s, other_columns(2, device))
        passage = Passage.of(collisions, self.sizes)
        limits = (config.clearance.parked_near_m, config.limits.curvature_max_1pm, config.clearance.station_m)
        return (
            GiveWay(config.give_way, self.road, passage, self.times) if config.give_way else None,
            Reversing(config.reversing, collisions, self.sizes, passage, limits) if config.reversing else None,
            Lingering(self.road, passage, float(self.times[-1])) if config.cost.lingering else None,
        )

    @property
    def n_combinations(self) -> int:
        """Number of trajectories checked per vehicle and decision."""
        return (self.longitudinal.n_candidates + self.braking.n_candidates) * self.lateral.n_candidates

    @property
    def n_around(self) -> int:
        """Number K of stations around each predicted vehicle at which a path is checked."""
        return len(self._around)

    def plan(self, perception: Perception, horizon: Tensor) -> Motion:
        """One step along the best feasible trajectory of every agent, given its prediction horizon [E, S] (s)."""
        shape = horizon.shape
        own = map_tensors(_flatten, perception.own)
        other = map_tensors(lambda field: _flatten(field).transpose(0, 1), perception.other)
        direction, desired_speed = perception.direction.flatten(), perception.desired_speed.flatten()
        *fields, direction, desired_speed = materialize(*self.road.to_route(own, direction), direction, desired_speed)
        route = RouteState(*fields)
        is_seen = _flatten(perception.is_seen).transpose(0, 1)  # [O, N]
        forwards = route._replace(s_dot=route.s_dot.clamp(min=0))
        after, is_full_braking = self._ahead(forwards, direction, desired_speed, horizon.flatten(), other, is_seen)
        if self.reversing is not None:
            others = self.reversing.others(other, direction, is_seen)
            reverses, back = self.reversing.plan(route, direction, horizon.flatten(), after, others)
            after = RouteState(*(torch.where(reverses, b, a) for b, a in zip(back, after, strict=True)))
            is_full_braking = is_full_braking & ~reverses
        state = self.road.to_world(after, direction)
        return Motion(
            map_tensors(lambda field: field.reshape(*shape, *field.shape[1:]), state),
            horizon,
            is_full_braking.reshape(shape),
        )

    def _ahead(
        self,
        route: RouteState,
        direction: Tensor,
        desired_speed: Tensor,
        horizon: Tensor,
        other: VehicleState,
        is_seen: Tensor,
    ) -> tuple[RouteState, Tensor]:
        """State one step forwards along the best trajectory, and whether it is full braking; fields [N]."""
        paths = self._paths(route, direction, desired_speed)
        predicted = predict(self.config.prediction, self.road, other, direction, self.times)
        seconds = horizon[None]  # [1 or O, N]
        if self.config.leader_horizon_s is not None:
            seconds = predicted_s(self.config.leader_horizon_s, self.road, route, direction, horizon, other)
        is_considered = (self.times[:, None] <= seconds[:, None] + self.dt_s / 2) & is_seen[:, None]  # [O, T, N]
        depth, at = self._depth(route, direction, paths, predicted, other.speed.abs())
        blocked = [self._interval(depth - slack, at, is_considered) for slack in self._slacks_m]
        rule = self._rule(horizon, route, direction, other, is_seen)
        lingering_cost = self._lingering_cost(route, direction, horizon, other, is_seen)
        cost, first_step = self._assess(route, desired_speed, paths, blocked, rule, lingering_cost)
        cost, best = cost.flatten(0, 1).min(dim=0)
        is_full_braking = torch.isinf(cost)
        following = self._follow(route, direction, first_step, paths, best)
        braking = self._brake(route, direction, paths)
        after = RouteState(*(torch.where(is_full_braking, b, f) for b, f in zip(braking, following, strict=True)))
        return after, is_full_braking

    def _rule(
        self, horizon: Tensor, route: RouteState, direction: Tensor, other: VehicleState, is_seen: Tensor
    ) -> "_Rule | None":
        """The rule of giving way, for those whose horizon is infinite; None where the planner has none."""
        give_way = self.give_way
        if give_way is None:
            return None
        is_bound = torch.isinf(horizon)
        others = give_way.times_of_others(other, route, direction, is_seen)
        to_passage = give_way.to_passage(route, direction)
        free_m = torch.where(is_bound & (to_passage > 0), to_passage, torch.inf)

        def allows(travelled: Tensor, speed: Tensor) -> Tensor:
            return give_way.allows(travelled, speed, route, direction, others) | ~is_bound

        return _Rule(free_m, allows)

    def _lingering_cost(
        self, route: RouteState, direction: Tensor, horizon: Tensor, other: VehicleState, is_seen: Tensor
    ) -> Callable[[Tensor, Tensor], Tensor] | None:
        """Function from candidates' `travelled` and `speed` [C, T, N] to a cost [C, N]; None where nothing costs."""
        lingering, weight = self.lingering, self.config.cost.lingering
        if lingering is None:
            return None
        is_met = lingering.is_met(route, direction, horizon, other, is_seen)
        return lambda travelled, speed: weight * lingering.lingers(travelled, speed, route, direction, is_met)

    def _paths(self, route: RouteState, direction: Tensor, desired_speed: Tensor) -> Paths:
        coefficients = self.lateral.start(route, direction)
        at = self.stations[:, None]  # [S, 1]
        d, d_prime, d_pprime = self.lateral.follow(coefficients, route.s, direction, at.expand(-1, len(direction)))
        s = route.s + at
        curvature, path_per_road, path_per_road_prime = path_shape(self.road, s, direction, d, d_prime, d_pprime)
        limits = self.config.limits
        allowed = (limits.lateral_accel_max_mps2 / desired_speed**2).clamp(max=limits.curvature_max_1pm)
        excess = torch.maximum(curvature.abs() - allowed, self.roadside.excess(s, direction, d, d_prime))
        first = torch.where(excess > 0, at, torch.inf).amin(1)
        weights = self.config.cost
        cost = weights.bend * torch.stack(coefficients[2:]).square().sum(0) + weights.offset * self.lateral.offset**2
        free_distance = first - self.config.clearance.station_m
        return Paths(coefficients, free_distance, path_per_road.amax(1), path_per_road_prime.abs().amax(1), cost)

    def _assess(
        self,
        route: RouteState,
        desired_speed: Tensor,
        paths: Paths,
        blocked: list[tuple[Tensor, Tensor]],
        rule: "_Rule | None",
        lingering_cost: Callable[[Tensor, Tensor], Tensor] | None,
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Costs [L, C, N] of all combinations, inf where one is not feasible.

        Returns with them what the longitudinal candidates are after one step: travelled, speed, accel, each [C, N].
        """
        samples = self.longitudinal.sample(route, desired_speed)
        is_feasible = self._is_drivable(samples, paths, route) & self._is_free(
            samples.travelled, paths, blocked[0], route
        )
        cost = paths.cost[:, None] + self._longitudinal_cost(samples, desired_speed)
        if rule is not None:
            is_feasible = is_feasible & rule.allows(samples.travelled, samples.speed)
        if lingering_cost is not None:
            cost = cost + lingering_cost(samples.travelled, samples.speed)
        cost = torch.where(is_feasible, cost, torch.inf)
        first_step = tuple(field[:, 0] for field in samples[:3])
        if self.braking.n_candidates == 0:
            return cost, first_step
        free_m = _free_distance(*blocked[0])
        stops = self.braking.sample(route, free_m if rule is None else torch.minimum(free_m, rule.free_m))
        stop_cost = self._stop_cost(stops, paths, desired_speed)
        strict, loose = (self._is_free(stops.travelled, paths, each, route) for each in blocked)
        if self.config.braking.standing_m is not None:
            loose = loose | (stops.travelled[:, -1] < self.config.braking.standing_m)
        has_room = stops.travelled[:, -1] + self.config.braking.room_m <= paths.free_distance[:, None]
        extra = torch.where(strict & has_room, 0.0, torch.where(loose, self.config.cost.closeness, torch.inf))
        stop_cost = stop_cost + extra
        if lingering_cost is not None:
            stop_cost = stop_cost + lingering_cost(stops.travelled, stops.speed)
        if rule is not None:
            stop_cost = torch.where(rule.allows(stops.travelled, stops.speed), stop_cost, torch.inf)
        stopping = (stops.travelled[:, 0], stops.speed[:, 0], stops.accel)
        both = tuple(torch.cat(pair) for pair in zip(first_step, stopping, strict=True))
        return torch.cat([cost, stop_cost], dim=1), both

    def _is_free(self, travelled: Tensor, paths: Paths, blocked: tuple[Tensor, Tensor], route: RouteState) -> Tensor:
        """[L, C, N] bool: candidates [C, T, N] (m) end where the path is drivable, and meet no predicted vehicle.

        Who stands meets nobody, where standing is a plan.
        """
        is_free = (travelled[:, -1] <= paths.free_distance[:, None]) & ~_conflicts(travelled, *blocked)
        if self.config.braking.standing_m is not None:
            is_free = is_free | ((route.s_dot == 0) & (travelled[:, -1] < STANDING_M))
        return is_free

    def _stop_cost(self, stops: BrakingSamples, paths: Paths, desired_speed: Tensor) -> Tensor:
        """[L, B, N]: cost of stops; inf where one brakes too hard or is not over within the plan."""
        limits, weights, path_per_road = self.config.limits, self.config.cost, paths.path_per_road[:, None]
        decel = stops.hardest * path_per_road + paths.path_per_road_prime[:, None] * stops.speed.amax(1) ** 2
        lag = stops.speed - desired_speed
        cost = paths.cost[:, None] + weights.jerk * stops.jerk_square + weights.speed * lag.square().mean(1)
        is_hard = (torch.arange(self.braking.n_candidates, device=cost.device) >= self.braking.n_comfortable)[:, None]
        allowed = torch.where(is_hard, self.config.braking.decel_max_mps2, limits.decel_max_mps2)
        cost = cost + torch.where(is_hard, weights.hard_braking * decel**2, 0.0)
        is_over = stops.speed[:, -1] < AT_REST_MPS / 10  # within the plan: nobody creeps on for a minute
        return torch.where((decel <= allowed) & is_over, cost, torch.inf)

    def _is_drivable(self, samples: LongitudinalSamples, paths: Paths, route: RouteState) -> Tensor:
        """[L, C, N] bool: speed, acceleration and jerk stay within the limits along the path at all times."""
        limits = self.config.limits
        tolerance = 0.05  # m/s: rounding and the last centimetres before standstill; executed speeds are >= 0
        is_ok = samples.speed.amin(1) >= -tolerance
        is_ok = is_ok & (torch.maximum(samples.jerk.abs().amax(1), samples.jerk_now.abs()) <= limits.jerk_max_mps3)
        fastest, path_per_road = samples.speed.amax(1), paths.path_per_road[:, None]
        shape_accel = paths.path_per_road_prime[:, None] * fastest**2  # m/s2, along the path, from its shape alone
        is_ok = is_ok & (fastest * path_per_road <= limits.speed_max_mps)
        is_ok = is_ok & (samples.accel.amax(1) * path_per_road + shape_accel <= limits.accel_max_mps2)
        return is_ok & (samples.accel.amin(1) * path_per_road - shape_accel >= -limits.decel_max_mps2)

    def _longitudinal_cost(self, samples: LongitudinalSamples, desired_speed: Tensor) -> Tensor:
        """[C, N]"""
        weights = self.config.cost
        lag = samples.speed - desired_speed
        return weights.jerk * samples.jerk.square().mean(1) + weights.speed * lag.square().mean(1)

    def _depth(
        self, route: RouteState, direction: Tensor, paths: Paths, predicted: PredictedPath, speed: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Depth of overlap [L, K, O, T, N] (m) with predicted vehicles at K stations around them, and the distances
        travelled [K, O, T, N] (m) to the stations.
        """
        size, clearance = self.sizes.ego, self.config.clearance
        around = self._around[:, None, None, None]  # [K, O, T, N]
        at = predicted.s - route.s + around
        d, d_prime, _ = self.lateral.follow(paths.coefficients, route.s, direction, at)
        u, v, tan_heading = self.road.in_tangent_frame(predicted.s, direction, around, d, d_prime)  # [L, K, O, T, N]
        cos, other_cos = torch.rsqrt(1 + tan_heading**2), torch.rsqrt(1 + predicted.tan_heading**2)
        own = Boxes(u, v, cos, tan_heading * cos, size.length / 2, size.width / 2)
        other = Boxes(
            torch.zeros_like(predicted.d),
            predicted.d,
            other_cos,
            predicted.tan_heading * other_cos,
            size.length / 2 + clearance.ahead_m,
            size.width / 2 + clearance.beside_m + clearance.beside_s * speed[:, None],
        )
        return overlap_depth(own, other), at

    def _interval(self, depth: Tensor, at: Tensor, is_considered: Tensor) -> tuple[Tensor, Tensor]:
        """First and last distance travelled [L, O, T, N] (m) with an overlap.

        The depth changes by about one metre per metre at most, so a path is free for x metres from a station with depth
        -x. The blocked interval begins and ends there. Where nothing is in the way, first > last.

        is_considered: [O, T, N] bool, the other is seen and the time lies within the prediction horizon
        """
        before, after = depth[:, :-1], depth[:, 1:]
        step = self._around[1] - self._around[0]
        entered = at[:-1] + torch.minimum((-before).clamp(min=0), step)
        left = at[1:] - torch.minimum((-after).clamp(min=0), step)
        first = torch.where(is_considered, torch.where(after > 0, entered, torch.inf), torch.inf).amin(1)
        last = torch.where(is_considered, torch.where(before > 0, left, -torch.inf), -torch.inf).amax(1)
        return first, last

    def _follow(
        self, route: RouteState, direction: Tensor, first_step: tuple[Tensor, ...], paths: Paths, best: Tensor
    ) -> RouteState:
        """State one step along the chosen combination [N] (flat index over L x C)."""
        n_longitudinal = len(first_step[0])
        row = (best % n_longitudinal)[None]
        travelled, speed, accel = (field.gather(0, row)[0] for field in first_step)
        is_at_rest = speed < 1e-3  # m/s
        speed = torch.where(is_at_rest, 0.0, speed)
        accel = torch.where(is_at_rest, 0.0, accel)
        travelled = torch.where(is_at_rest & (route.s_dot == 0), 0.0, travelled.clamp(min=0))  # no creeping
        chosen = best // n_longitudinal
        return self._on_path(route, direction, paths, chosen, travelled, speed, accel)

    def _brake(self, route: RouteState, direction: Tensor, paths: Paths) -> RouteState:
        """State one step into full braking, on the path that stays free the longest."""
        path_per_road = path_shape(self.road, route.s, direction, route.d, route.d_prime, route.d_pprime)[1]
        decel, dt = self.config.limits.full_braking_mps2 / path_per_road, self.dt_s  # the limit holds along the path
        moving_s = (route.s_dot / decel).clamp(max=dt)
        travelled = route.s_dot * moving_s - decel * moving_s**2 / 2
        speed = (route.s_dot - decel * dt).clamp(min=0)
        accel = torch.where(speed > 0, -decel, 0.0)
        return self._on_path(route, direction, paths, paths.free_distance.argmax(0), travelled, speed, accel)

    def _on_path(
        self,
        route: RouteState,
        direction: Tensor,
        paths: Paths,
        chosen: Tensor,
        travelled: Tensor,
        speed: Tensor,
        accel: Tensor,
    ) -> RouteState:
        all_paths = self.lateral.follow(paths.coefficients, route.s, direction, travelled)
        point = (field.gather(0, chosen[None])[0] for field in all_paths)
        return RouteState(route.s + travelled, speed, accel, *point)


class _Rule(NamedTuple):
    """The rule of giving way in one plan of N vehicles.

    free_m: [N] m, distance to the passage; inf for who is in it or need not give way
    allows: candidates' `travelled` and `speed` [C, T, N] -> [C, N] bool
    """

    free_m: Tensor
    allows: Callable[[Tensor, Tensor], Tensor]


def _conflicts(travelled: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """[L, C, N] bool: a vehicle that has `travelled` [C, T, N] (m) is within a blocked interval at some time."""
    travelled = travelled[:, None]  # [C, O, T, N]
    within = torch.minimum(travelled - first[:, None], last[:, None] - travelled)  # [L, C, O, T, N]
    return within.amax((2, 3)) > 0


def _free_distance(first: Tensor, last: Tensor) -> Tensor:
    """[N] m: distance to the first place that is ever blocked ahead, on the path on which it is the farthest."""
    return torch.where(last > 0, first, torch.inf).amin((1, 2)).amax(0)


def _flatten(field: Tensor) -> Tensor:
    return field.flatten(0, 1)


def _parked_clearance(config: ClearanceConfig, ahead: Tensor) -> Tensor:
    """[S] m: clearance to kerbs and parked cars at the distances `ahead` [S] (m) of the vehicle."""
    share = (ahead / config.parked_full_at_m).clamp(max=1)
    return config.parked_near_m + (config.parked_m - config.parked_near_m) * share


def _stations_around(config: PlannerConfig, largest: Size) -> Tensor:
    """[K] m, evenly spread over the distances at which two footprints with their clearances can touch at all."""
    reach = config.touching_m(largest)
    return torch.linspace(-reach, reach, config.n_around(largest))
