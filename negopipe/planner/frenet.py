"""The planner: sample, check, cost, choose (Werling 2010; problem (1) of the paper).

Axes here: N vehicles that plan (worlds and agents flattened), O others that each perceives, C longitudinal and
L lateral candidates, T times, P parked cars, S stations along a path, K stations around a predicted vehicle. N
stands last in every tensor: whatever is computed per vehicle runs on vector units, and no axis has to be moved.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from pydantic import model_validator
from torch import Tensor

from negopipe.checks import FLOAT_BYTES, N_TEMPORARIES, Memory, Problem, check_times
from negopipe.planner.lateral import LateralCandidates, LateralConfig
from negopipe.planner.longitudinal import LongitudinalCandidates, LongitudinalConfig, LongitudinalSamples
from negopipe.planner.prediction import PredictedPath, PredictionConfig, predict
from negopipe.planner.roadside import Roadside
from negopipe.schema import NonNegativeFloat, NonNegativeMetres, PositiveFloat, PositiveMetres, schema
from negopipe.simulation.geometry import Boxes, overlap_depth
from negopipe.simulation.perception import Perception
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.scenario import ScenarioConfig, VehicleConfig
from negopipe.simulation.state import Motion
from negopipe.tensors.materialize import materialize
from negopipe.tensors.tree import map_tensors


@schema
class LimitConfig:
    """What a trajectory may ask of the vehicle; `full_braking_mps2` applies when no candidate is feasible."""

    speed_max_mps: PositiveFloat
    accel_max_mps2: PositiveFloat
    decel_max_mps2: PositiveFloat
    jerk_max_mps3: PositiveFloat
    lateral_accel_max_mps2: PositiveFloat
    curvature_max_1pm: PositiveFloat
    full_braking_mps2: PositiveFloat


@schema
class ClearanceConfig:
    """Margins that the planner keeps; true collisions are the simulator's matter.

    parked_near_m: to kerbs and parked cars, right where the vehicle is; it grows along the path to parked_m, reached
        parked_full_at_m ahead. What was drivable from afar so stays drivable from near, small errors included
        (constraint tightening, Richards & How 2006), and a vehicle can leave wherever it could stop
    beside_s: more room beside a vehicle, per m/s of its speed: who waits for a moving vehicle leaves it more room
        than it needs to creep past a standing one, so that a waiting place is one that can be passed
    """

    parked_m: NonNegativeMetres
    parked_near_m: NonNegativeMetres
    parked_full_at_m: PositiveMetres
    ahead_m: NonNegativeMetres
    beside_m: NonNegativeMetres
    beside_s: NonNegativeFloat
    station_m: PositiveMetres
    conflict_station_m: PositiveMetres

    @model_validator(mode="after")
    def _grows(self) -> "ClearanceConfig":
        if self.parked_near_m > self.parked_m:
            raise ValueError(f"parked_near_m {self.parked_near_m} must be at most parked_m {self.parked_m}")
        return self


@schema
class CostConfig:
    """Weights of the conjoint cost."""

    jerk: NonNegativeFloat
    speed: NonNegativeFloat
    offset: NonNegativeFloat
    bend: NonNegativeFloat


@schema
class PlannerConfig:
    """`conf/planner/frenet.yaml` says what each value means."""

    horizon_s: PositiveFloat
    longitudinal: LongitudinalConfig
    lateral: LateralConfig
    limits: LimitConfig
    clearance: ClearanceConfig
    cost: CostConfig
    prediction: PredictionConfig

    def n_times(self, dt_s: float) -> int:
        """T, control steps of a plan."""
        return round(self.horizon_s / dt_s)

    @property
    def n_stations(self) -> int:
        """S, points along a path at which it is checked against kerbs and parked cars."""
        return int(self.limits.speed_max_mps * self.horizon_s / self.clearance.station_m) + 1

    def touching_m(self, vehicle: VehicleConfig) -> float:
        """Distance at which two footprints with their clearances can touch at all."""
        clearance, half_length, half_width = self.clearance, vehicle.length_m / 2, vehicle.width_m / 2
        beside = clearance.beside_m + clearance.beside_s * self.limits.speed_max_mps
        return math.hypot(half_length, half_width) + math.hypot(half_length + clearance.ahead_m, half_width + beside)

    def n_around(self, vehicle: VehicleConfig) -> int:
        """K, points around a predicted vehicle at which a path is checked against it."""
        return math.ceil(2 * self.touching_m(vehicle) / self.clearance.conflict_station_m) + 1

    def check(self, dt_s: float) -> Iterator[Problem]:
        yield from check_times({"planner.horizon_s": (self.horizon_s,)}, dt_s)

    def memory(self, scenario: ScenarioConfig, n_worlds: int) -> Memory:
        """Memory of one plan of every vehicle in `n_worlds` worlds."""
        n_paths = n_worlds * (1 + scenario.n_social) * self.lateral.n_candidates
        n_met = scenario.n_social * self.n_times(scenario.dt_s)
        n_checks = n_met * (self.longitudinal.n_candidates + self.n_around(scenario.vehicle)) + self.n_stations
        keys = "scenario.n_social planner.horizon_s scenario.dt_s planner.longitudinal.keep_fractions"
        keys += " planner.lateral.offsets_m planner.clearance.station_m planner.clearance.conflict_station_m"
        return Memory("a plan", n_paths * n_checks * FLOAT_BYTES * N_TEMPORARIES, tuple(keys.split()))


class Paths(NamedTuple):
    """Lateral candidates that start at the present states.

    coefficients: six tensors [L, N] of the quintics
    free_distance: [L, N] m, how far along the road the path may be driven: before the first point at which it is
        too sharp or comes too close to a kerb or a parked car
    stretch: [L, N], the most metres of path per metre of road
    stretching: [L, N] 1/m, the fastest change of that: driving along the road at a constant speed, the vehicle
        speeds up along its path by at most `stretching` times the square of that speed
    cost: [L, N]
    """

    coefficients: tuple[Tensor, ...]
    free_distance: Tensor
    stretch: Tensor
    stretching: Tensor
    cost: Tensor


class FrenetPlanner:
    """Plans for any number of vehicles in one call; they differ by state and prediction horizon only."""

    def __init__(
        self,
        config: PlannerConfig,
        road: Road,
        vehicle: VehicleConfig,
        dt_s: float,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config, self.road, self.vehicle, self.dt_s = config, road, vehicle, dt_s
        self.times = torch.arange(1, config.n_times(dt_s) + 1, device=device) * dt_s
        self.longitudinal = LongitudinalCandidates(config.longitudinal, self.times)
        self.lateral = LateralCandidates(config.lateral, road, device)
        self.stations = torch.arange(1, config.n_stations + 1, device=device) * config.clearance.station_m
        self.roadside = Roadside(road, vehicle, _parked_clearance(config.clearance, self.stations))
        self._around = _stations_around(config, vehicle).to(device)  # [K] m

    @property
    def n_combinations(self) -> int:
        """Trajectories checked per vehicle and decision."""
        return self.longitudinal.n_candidates * self.lateral.n_candidates

    @property
    def n_around(self) -> int:
        """Stations K around each predicted vehicle at which a path is checked."""
        return len(self._around)

    def plan(self, perception: Perception, horizon: Tensor) -> Motion:
        """Best feasible trajectory of every agent, given its prediction horizon [E, S] (s)."""
        shape = horizon.shape
        own = map_tensors(_flatten, perception.own)
        other = map_tensors(lambda field: _flatten(field).transpose(0, 1), perception.other)
        direction, desired_speed = perception.direction.flatten(), perception.desired_speed.flatten()
        *fields, direction, desired_speed = materialize(*self.road.to_route(own, direction), direction, desired_speed)
        route = RouteState(*fields)
        samples = self.longitudinal.sample(route, desired_speed)
        paths = self._paths(route, direction, desired_speed)
        is_feasible = self._is_drivable(samples, paths, route)
        is_feasible = is_feasible & (samples.travelled[:, -1] <= paths.free_distance[:, None])
        predicted = predict(self.config.prediction, self.road, other, direction, self.times)
        is_predicted = self.times[:, None] <= horizon.flatten() + self.dt_s / 2  # [T, N]
        counts = is_predicted & _flatten(perception.is_seen).transpose(0, 1)[:, None]  # [O, T, N]
        first, last = self._blocked(route, direction, paths, predicted, other.speed, counts)
        is_feasible = is_feasible & ~_conflicts(samples.travelled, first, last)
        cost = paths.cost[:, None] + self._longitudinal_cost(samples, desired_speed)
        cost, best = torch.where(is_feasible, cost, torch.inf).flatten(0, 1).min(dim=0)
        is_full_braking = torch.isinf(cost)
        following = self._follow(route, direction, samples, paths, best)
        braking = self._brake(route, direction, paths)
        after = RouteState(*(torch.where(is_full_braking, b, f) for b, f in zip(braking, following, strict=True)))
        state = self.road.to_world(after, direction)
        return Motion(
            map_tensors(lambda field: field.reshape(*shape, *field.shape[1:]), state),
            horizon,
            is_full_braking.reshape(shape),
        )

    def _paths(self, route: RouteState, direction: Tensor, desired_speed: Tensor) -> Paths:
        coefficients = self.lateral.start(route, direction)
        at = self.stations[:, None]  # [S, 1]
        d, slope, bend = self.lateral.follow(coefficients, route.s, direction, at.expand(-1, len(direction)))
        s = route.s + at
        curvature, stretch, stretching = self._shape(s, direction, d, slope, bend)
        limits = self.config.limits
        allowed = (limits.lateral_accel_max_mps2 / desired_speed**2).clamp(max=limits.curvature_max_1pm)
        excess = torch.maximum(curvature.abs() - allowed, self.roadside.excess(s, direction, d, slope))
        first = torch.where(excess > 0, at, torch.inf).amin(1)
        weights = self.config.cost
        cost = weights.bend * torch.stack(coefficients[2:]).square().sum(0) + weights.offset * self.lateral.offset**2
        free_distance = first - self.config.clearance.station_m
        return Paths(coefficients, free_distance, stretch.amax(1), stretching.abs().amax(1), cost)

    def _shape(
        self, s: Tensor, direction: Tensor, d: Tensor, slope: Tensor, bend: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Of points on paths: curvature (1/m), metres of path per metre of road and the change of that (1/m)."""
        if self.road.reference.is_straight:
            stretch = torch.sqrt(1 + slope**2)
            return bend / stretch**3, stretch, slope * bend / stretch
        kappa, kappa_prime = self.road.curvature(s, direction)
        scale = 1 - kappa * d
        bulge = kappa_prime * d + kappa * slope  # (kappa d)'
        stretch = torch.sqrt(scale**2 + slope**2)
        turn = (scale * bend + slope * bulge) / stretch**2  # of the heading relative to the line
        return (turn + kappa) / stretch, stretch, (slope * bend - scale * bulge) / stretch

    def _is_drivable(self, samples: LongitudinalSamples, paths: Paths, route: RouteState) -> Tensor:
        """[L, C, N] bool: speed, acceleration and jerk stay within the limits along the path at all times."""
        limits = self.config.limits
        tolerance = 0.05  # m/s: rounding and the last centimetres before standstill; executed speeds are >= 0
        is_ok = samples.speed.amin(1) >= -tolerance
        is_ok = is_ok & (torch.maximum(samples.jerk.abs().amax(1), samples.jerk_now.abs()) <= limits.jerk_max_mps3)
        fastest, stretch = samples.speed.amax(1), paths.stretch[:, None]
        swing = paths.stretching[:, None] * fastest**2
        is_ok = is_ok & (fastest * stretch <= limits.speed_max_mps)
        is_ok = is_ok & (samples.accel.amax(1) * stretch + swing <= limits.accel_max_mps2)
        return is_ok & (samples.accel.amin(1) * stretch - swing >= -limits.decel_max_mps2)

    def _longitudinal_cost(self, samples: LongitudinalSamples, desired_speed: Tensor) -> Tensor:
        """[C, N]"""
        weights = self.config.cost
        lag = samples.speed - desired_speed
        return weights.jerk * samples.jerk.square().mean(1) + weights.speed * lag.square().mean(1)

    def _blocked(
        self,
        route: RouteState,
        direction: Tensor,
        paths: Paths,
        predicted: PredictedPath,
        speed: Tensor,
        counts: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """First and last distance travelled [L, O, T, N] (m) at which a predicted vehicle is in the way.

        At K stations around where the other is predicted, the depth of overlap is measured. It changes by about a
        metre per metre at most, so from a free station that lies at depth -x nothing is met for x metres: that
        is where the blocked stretch is taken to begin and to end. Where nothing is in the way, first > last.

        counts: [O, T, N] bool, the other is seen and the time lies within the prediction horizon
        """
        size, clearance = self.vehicle, self.config.clearance
        around = self._around[:, None, None, None]  # [K, O, T, N]
        at = predicted.s - route.s + around
        d, slope, _ = self.lateral.follow(paths.coefficients, route.s, direction, at)
        u, v, slope = self.road.in_tangent_frame(predicted.s, direction, around, d, slope)  # [L, K, O, T, N]
        cos, other_cos = torch.rsqrt(1 + slope**2), torch.rsqrt(1 + predicted.slope**2)
        own = Boxes(u, v, cos, slope * cos, size.length_m / 2, size.width_m / 2)
        other = Boxes(
            torch.zeros_like(predicted.d),
            predicted.d,
            other_cos,
            predicted.slope * other_cos,
            size.length_m / 2 + clearance.ahead_m,
            size.width_m / 2 + clearance.beside_m + clearance.beside_s * speed[:, None],
        )
        depth = overlap_depth(own, other)
        before, after = depth[:, :-1], depth[:, 1:]
        step = self._around[1] - self._around[0]
        entered = at[:-1] + torch.minimum((-before).clamp(min=0), step)
        left = at[1:] - torch.minimum((-after).clamp(min=0), step)
        first = torch.where(counts, torch.where(after > 0, entered, torch.inf), torch.inf).amin(1)
        last = torch.where(counts, torch.where(before > 0, left, -torch.inf), -torch.inf).amax(1)
        return first, last

    def _follow(
        self, route: RouteState, direction: Tensor, samples: LongitudinalSamples, paths: Paths, best: Tensor
    ) -> RouteState:
        """State one step along the chosen combination [N] (flat index over L x C)."""
        n_longitudinal = self.longitudinal.n_candidates
        row = (best % n_longitudinal)[None]
        travelled, speed, accel = (field[:, 0].gather(0, row)[0] for field in samples[:3])
        is_at_rest = speed < 1e-3
        speed = torch.where(is_at_rest, 0.0, speed)
        accel = torch.where(is_at_rest, 0.0, accel)
        travelled = torch.where(is_at_rest & (route.s_dot == 0), 0.0, travelled.clamp(min=0))  # nobody creeps
        chosen = best // n_longitudinal
        return self._on_path(route, direction, paths, chosen, travelled, speed, accel)

    def _brake(self, route: RouteState, direction: Tensor, paths: Paths) -> RouteState:
        """State one step into full braking, on the path that stays free the longest."""
        stretch = self._shape(route.s, direction, route.d, route.d_prime, route.d_pprime)[1]
        decel, dt = self.config.limits.full_braking_mps2 / stretch, self.dt_s  # the limit holds along the path
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


def _conflicts(travelled: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """[L, C, N] bool: a vehicle that has `travelled` [C, T, N] (m) is within a blocked stretch at some time."""
    travelled = travelled[:, None]  # [C, O, T, N]
    within = torch.minimum(travelled - first[:, None], last[:, None] - travelled)  # [L, C, O, T, N]
    return within.amax((2, 3)) > 0


def _flatten(field: Tensor) -> Tensor:
    return field.flatten(0, 1)


def _parked_clearance(config: ClearanceConfig, ahead: Tensor) -> Tensor:
    """[S] m, to be kept from kerbs and parked cars at points so far ahead."""
    share = (ahead / config.parked_full_at_m).clamp(max=1)
    return config.parked_near_m + (config.parked_m - config.parked_near_m) * share


def _stations_around(config: PlannerConfig, vehicle: VehicleConfig) -> Tensor:
    """[K] m, evenly spread over the distances at which two footprints with their clearances can touch at all."""
    reach = config.touching_m(vehicle)
    return torch.linspace(-reach, reach, config.n_around(vehicle))
