"""The planner: sample, check, cost, choose (Werling 2010; problem (1) of the paper).

Axes here: N vehicles that plan (worlds and agents flattened), O others that each perceives, C longitudinal and
L lateral candidates, T times, P parked cars, S stations along a path, K places around a predicted vehicle. N is the
last axis of every tensor, so that computations per vehicle run on vector units and no axis has to be moved.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.planner.braking import BrakingCandidates, BrakingSamples
from negopipe.planner.config import ClearanceConfig, PlannerConfig
from negopipe.planner.conflicts import Blocked, ConflictCheck
from negopipe.planner.following import predicted_s
from negopipe.planner.give_way import GiveWay
from negopipe.planner.lateral import LateralCandidates, path_shape
from negopipe.planner.lingering import Lingering
from negopipe.planner.longitudinal import LongitudinalCandidates, LongitudinalSamples
from negopipe.planner.prediction import predict
from negopipe.planner.reversing import Reversing
from negopipe.planner.roadside import Roadside
from negopipe.planner.situation import Situation
from negopipe.simulation.collisions import CollisionCheck
from negopipe.simulation.perception import Perception, other_columns
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.sizes import Sizes
from negopipe.simulation.state import AT_REST_MPS, Motion, VehicleState
from negopipe.simulation.waiting_place import Passage
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


class Choice(NamedTuple):
    """The cheapest combinations of N vehicles that plan.

    samples, stops: the longitudinal candidates; stops is None where the planner has none
    best: [N] int64, flat index over L x C
    is_full_braking: [N] bool, no combination is feasible
    """

    paths: Paths
    samples: LongitudinalSamples
    stops: BrakingSamples | None
    best: Tensor
    is_full_braking: Tensor

    @property
    def first_step(self) -> tuple[Tensor, ...]:
        """The longitudinal candidates after one step: travelled, speed, accel, each [C, N]."""
        first = tuple(field[:, 0] for field in self.samples[:3])
        if self.stops is None:
            return first
        stopping = (self.stops.travelled[:, 0], self.stops.speed[:, 0], self.stops.accel)
        return tuple(torch.cat(pair) for pair in zip(first, stopping, strict=True))

    def all_steps(self, dt_s: float) -> tuple[Tensor, ...]:
        """The same at all times, each [C, T, N]; from the second step on, the acceleration of a stop is its mean."""
        if self.stops is None:
            return tuple(self.samples[:3])
        speed = self.stops.speed
        accel = torch.cat([self.stops.accel[:, None], speed.diff(dim=1) / dt_s], dim=1)
        stopping = (self.stops.travelled, speed, accel)
        return tuple(torch.cat(pair) for pair in zip(self.samples[:3], stopping, strict=True))


class FrenetPlanner:
    """Planner of any number of vehicles in one call; they differ in state, size and prediction horizon only."""

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
        self.conflicts = ConflictCheck(config, road, sizes, self.lateral, device)

    def _rules(self, device: torch.device | str) -> tuple[GiveWay | None, Reversing | None, Lingering | None]:
        """The rules at a passage; None where the planner has none."""
        config = self.config
        if config.give_way is None and config.reversing is None and not config.cost.lingering:
            return None, None, None
        collisions = CollisionCheck(self.road, self.dt_s, other_columns(2, device))
        passage = Passage.of(collisions, self.sizes)
        limits = (config.clearance.parked_near_m, config.limits.curvature_max_1pm, config.clearance.station_m)
        return (
            GiveWay(config.give_way, passage, self.times) if config.give_way else None,
            Reversing(config.reversing, collisions, passage, limits) if config.reversing else None,
            Lingering(passage, float(self.times[-1])) if config.cost.lingering else None,
        )

    @property
    def n_combinations(self) -> int:
        """Number of trajectories checked per vehicle and decision."""
        return (self.longitudinal.n_candidates + self.braking.n_candidates) * self.lateral.n_candidates

    def plan(self, perception: Perception, horizon: Tensor) -> Motion:
        """One step along the best feasible trajectory of every agent, given its prediction horizon [E, S] (s)."""
        shape = horizon.shape
        now = self.situation(perception, horizon)
        after, is_full_braking = self._ahead(now._replace(route=now.route._replace(s_dot=now.route.s_dot.clamp(min=0))))
        if self.reversing is not None:
            reverses, back = self.reversing.plan(now, after)
            after = RouteState(*(torch.where(reverses, b, a) for b, a in zip(back, after, strict=True)))
            is_full_braking = is_full_braking & ~reverses
        state = self.road.to_world(after, now.direction)
        return Motion(
            map_tensors(lambda field: field.reshape(*shape, *field.shape[1:]), state),
            horizon,
            is_full_braking.reshape(shape),
        )

    def trajectory(self, perception: Perception, horizon: Tensor) -> tuple[VehicleState, Tensor]:
        """The whole plan of every agent: states [E, S, T] at `times`, and whether it is full braking [E, S].

        The first state is that of `plan`. Who drives backwards plans one step of that and then to come to rest.
        """
        now = self.situation(perception, horizon)
        ahead = now._replace(route=now.route._replace(s_dot=now.route.s_dot.clamp(min=0)))
        choice = self._choose(ahead)
        route, is_full_braking = (
            self._along(ahead, choice, choice.all_steps(self.dt_s), self.times[:, None]),
            choice.is_full_braking,
        )
        if self.reversing is not None:
            reverses, back = self.reversing.plan(now, RouteState(*(field[0] for field in route)))
            back = self.reversing.to_rest(now, back, self.times)
            route = RouteState(*(torch.where(reverses, b, a) for b, a in zip(back, route, strict=True)))
            is_full_braking = is_full_braking & ~reverses
        states = self.road.to_world(route, now.direction)
        shape = horizon.shape
        return (
            map_tensors(lambda field: field.movedim(0, 1).reshape(*shape, len(self.times), *field.shape[2:]), states),
            is_full_braking.reshape(shape),
        )

    def situation(self, perception: Perception, horizon: Tensor) -> Situation:
        """Situation of all agents, with their prediction horizons [E, S] (s), N = E S."""
        return Situation.of(self.road, self.sizes, perception, horizon)

    def _ahead(self, now: Situation) -> tuple[RouteState, Tensor]:
        """State one step forwards along the best trajectory, and whether it is full braking; fields [N]."""
        choice = self._choose(now)
        return self._along(now, choice, choice.first_step, self.dt_s), choice.is_full_braking

    def _choose(self, now: Situation) -> Choice:
        paths = self._paths(now)
        blocked = self._blocked(now, paths)
        cost, samples, stops = self._assess(now, paths, blocked, self._rule(now), self._lingering_cost(now))
        cost, best = cost.flatten(0, 1).min(dim=0)
        return Choice(paths, samples, stops, best, torch.isinf(cost))

    def _along(self, now: Situation, choice: Choice, steps: tuple[Tensor, ...], seconds: float | Tensor) -> RouteState:
        """States along the choice at `seconds`: [N] after a number, [T, N] after times [T, 1].

        steps: travelled, speed, accel of the longitudinal candidates then, [C, N] or [C, T, N]
        """
        following, braking = self._follow(now, steps, choice), self._brake(now, choice.paths, seconds)
        is_full_braking = choice.is_full_braking
        return RouteState(*(torch.where(is_full_braking, b, f) for b, f in zip(braking, following, strict=True)))

    def _blocked(self, now: Situation, paths: Paths) -> list[Blocked]:
        """What the predicted vehicles block, strictly, and for stops that may come closer."""
        predicted = predict(self.config.prediction, self.road, now.others, now.direction, self.times)
        seconds = now.horizon[None]  # [1 or O, N]
        if self.config.leader_horizon_s is not None:
            seconds = predicted_s(self.config.leader_horizon_s, now)
        is_predicted = self.times[:, None] <= seconds[:, None] + self.dt_s / 2
        is_considered = is_predicted & now.others.is_seen[:, None]  # [O, T, N]
        return self.conflicts.blocked(now, paths.coefficients, predicted, is_considered)

    def _rule(self, now: Situation) -> "_Rule | None":
        """The rule of giving way, for those whose horizon is infinite; None where the planner has none."""
        give_way = self.give_way
        if give_way is None:
            return None
        is_bound = torch.isinf(now.horizon)
        others = give_way.times_of_others(now)
        to_passage = give_way.to_passage(now)
        free_m = torch.where(is_bound & (to_passage > 0), to_passage, torch.inf)

        def allows(travelled: Tensor, speed: Tensor) -> Tensor:
            return give_way.allows(travelled, speed, now, others) | ~is_bound

        return _Rule(free_m, allows)

    def _lingering_cost(self, now: Situation) -> Callable[[Tensor, Tensor], Tensor] | None:
        """Function from candidates' `travelled` and `speed` [C, T, N] to a cost [C, N]; None where nothing costs."""
        lingering, weight = self.lingering, self.config.cost.lingering
        if lingering is None:
            return None
        is_met = lingering.is_met(now)
        return lambda travelled, speed: weight * lingering.lingers(travelled, speed, now, is_met)

    def _paths(self, now: Situation) -> Paths:
        route, direction = now.route, now.direction
        coefficients = self.lateral.start(route, direction)
        at = self.stations[:, None]  # [S, 1]
        d, d_prime, d_pprime = self.lateral.follow(coefficients, route.s, direction, at.expand(-1, len(direction)))
        s = route.s + at
        curvature, path_per_road, path_per_road_prime = path_shape(self.road, s, direction, d, d_prime, d_pprime)
        limits = self.config.limits
        allowed = (limits.lateral_accel_max_mps2 / now.desired_speed**2).clamp(max=limits.curvature_max_1pm)
        excess = torch.maximum(curvature.abs() - allowed, self.roadside.excess(s, direction, d, d_prime, now.size))
        first = torch.where(excess > 0, at, torch.inf).amin(1)
        weights = self.config.cost
        cost = weights.bend * torch.stack(coefficients[2:]).square().sum(0) + weights.offset * self.lateral.offset**2
        free_distance = first - self.config.clearance.station_m
        return Paths(coefficients, free_distance, path_per_road.amax(1), path_per_road_prime.abs().amax(1), cost)

    def _assess(
        self,
        now: Situation,
        paths: Paths,
        blocked: list[Blocked],
        rule: "_Rule | None",
        lingering_cost: Callable[[Tensor, Tensor], Tensor] | None,
    ) -> tuple[Tensor, LongitudinalSamples, BrakingSamples | None]:
        """Costs [L, C, N] of all combinations, inf where one is not feasible, and their longitudinal candidates."""
        route, desired_speed = now.route, now.desired_speed
        at_stops = self._as_ego(now)
        samples = self.longitudinal.sample(at_stops, desired_speed)
        is_feasible = self._is_drivable(samples, paths) & self._is_free(samples.travelled, paths, blocked[0], route)
        cost = paths.cost[:, None] + self._longitudinal_cost(samples, desired_speed)
        if rule is not None:
            is_feasible = is_feasible & rule.allows(samples.travelled, samples.speed)
        if lingering_cost is not None:
            cost = cost + lingering_cost(samples.travelled, samples.speed)
        cost = torch.where(is_feasible, cost, torch.inf)
        if self.braking.n_candidates == 0:
            return cost, samples, None
        free_m = blocked[0].free_m
        stops = self.braking.sample(at_stops, free_m if rule is None else torch.minimum(free_m, rule.free_m))
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
        return torch.cat([cost, stop_cost], dim=1), samples, stops

    def _as_ego(self, now: Situation) -> RouteState:
        """The route state of a vehicle as long as the ego with the same front: of such are the places of stops."""
        if self.sizes.is_one:
            return now.route
        return now.route._replace(s=now.route.s + self.sizes.longer_m(now.size.length))

    def _is_free(self, travelled: Tensor, paths: Paths, blocked: Blocked, route: RouteState) -> Tensor:
        """[L, C, N] bool: candidates [C, T, N] (m) end where the path is drivable, and meet no predicted vehicle.

        Who stands meets nobody, where standing is a plan.
        """
        is_free = (travelled[:, -1] <= paths.free_distance[:, None]) & ~blocked.holds_up(travelled)
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

    def _is_drivable(self, samples: LongitudinalSamples, paths: Paths) -> Tensor:
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

    def _follow(self, now: Situation, steps: tuple[Tensor, ...], choice: Choice) -> RouteState:
        """State along the chosen combination; steps: of `_along`."""
        n_longitudinal = len(steps[0])
        travelled, speed, accel = (_chosen(field, choice.best % n_longitudinal) for field in steps)
        is_at_rest = speed < 1e-3  # m/s
        speed = torch.where(is_at_rest, 0.0, speed)
        accel = torch.where(is_at_rest, 0.0, accel)
        travelled = torch.where(is_at_rest & (now.route.s_dot == 0), 0.0, travelled.clamp(min=0))  # no creeping
        return self._on_path(now, choice.paths, choice.best // n_longitudinal, (travelled, speed, accel))

    def _brake(self, now: Situation, paths: Paths, seconds: float | Tensor) -> RouteState:
        """State `seconds` into full braking, on the path that stays free the longest."""
        route = now.route
        path_per_road = path_shape(self.road, route.s, now.direction, route.d, route.d_prime, route.d_pprime)[1]
        decel = self.config.limits.full_braking_mps2 / path_per_road  # the limit holds along the path
        moving_s = (route.s_dot / decel).clamp(max=seconds)
        travelled = route.s_dot * moving_s - decel * moving_s**2 / 2
        speed = (route.s_dot - decel * seconds).clamp(min=0)
        accel = torch.where(speed > 0, -decel, 0.0)
        return self._on_path(now, paths, paths.free_distance.argmax(0), (travelled, speed, accel))

    def _on_path(
        self, now: Situation, paths: Paths, chosen: Tensor, motion: tuple[Tensor, Tensor, Tensor]
    ) -> RouteState:
        """State on the chosen path [N] with `motion`: distance travelled (m), speed (m/s), acceleration (m/s2)."""
        travelled, speed, accel = motion
        all_paths = self.lateral.follow(paths.coefficients, now.route.s, now.direction, travelled)
        point = (_chosen(field, chosen) for field in all_paths)
        return RouteState(now.route.s + travelled, speed, accel, *point)


class _Rule(NamedTuple):
    """The rule of giving way in one plan of N vehicles.

    free_m: [N] m, distance to the passage; inf for who is in it or need not give way
    allows: candidates' `travelled` and `speed` [C, T, N] -> [C, N] bool
    """

    free_m: Tensor
    allows: Callable[[Tensor, Tensor], Tensor]


def _chosen(field: Tensor, row: Tensor) -> Tensor:
    """[..., N] from candidates [C, ..., N]: of each vehicle that of its row [N]."""
    return field.gather(0, row.expand(1, *field.shape[1:]))[0]


def _parked_clearance(config: ClearanceConfig, ahead: Tensor) -> Tensor:
    """[S] m: clearance to kerbs and parked cars at the distances `ahead` [S] (m) of the vehicle."""
    share = (ahead / config.parked_full_at_m).clamp(max=1)
    return config.parked_near_m + (config.parked_m - config.parked_near_m) * share
