"""The planner: sample, check, cost, choose (Werling 2010; problem (1) of the paper).

Axes here: N vehicles that plan (worlds and seats flattened), O others that each perceives, C longitudinal and
L lateral candidates, T times, P parked cars, S stations along a path.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.planner.lateral import LateralCandidates, LateralConfig
from negopipe.planner.longitudinal import LongitudinalCandidates, LongitudinalConfig, LongitudinalSamples
from negopipe.planner.prediction import PredictedPath, PredictionConfig, predict
from negopipe.schema import NonNegativeFloat, PositiveFloat, schema
from negopipe.simulation.geometry import Boxes, overlap_depth
from negopipe.simulation.perception import Perception
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.scenario import VehicleConfig
from negopipe.simulation.state import Motion, map_tensors


@schema
class LimitConfig:
    """What a trajectory may ask of the vehicle; `full_braking_mps2` applies when no candidate is feasible."""

    speed_max_mps: PositiveFloat
    accel_max_mps2: PositiveFloat
    decel_max_mps2: PositiveFloat
    lateral_accel_max_mps2: PositiveFloat
    curvature_max_1pm: PositiveFloat
    full_braking_mps2: PositiveFloat


@schema
class ClearanceConfig:
    """Margins that the planner keeps; true collisions are the simulator's matter.

    beside_s: more room beside a vehicle, per m/s of its speed: who waits for a moving vehicle leaves it more room
        than it needs to creep past a standing one, so that a waiting place is one that can be passed
    """

    parked_m: NonNegativeFloat
    ahead_m: NonNegativeFloat
    beside_m: NonNegativeFloat
    beside_s: NonNegativeFloat
    station_m: PositiveFloat


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


class Paths(NamedTuple):
    """Lateral candidates that start at the present states.

    coefficients: six tensors [N, L] of the quintics
    free_distance: [N, L] m, how far along the road the path may be driven: before the first point at which it is
        too sharp or comes too close to a kerb or a parked car
    cost: [N, L]
    """

    coefficients: tuple[Tensor, ...]
    free_distance: Tensor
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
        n_times = round(config.horizon_s / dt_s)
        self.times = torch.arange(1, n_times + 1, device=device) * dt_s
        self.longitudinal = LongitudinalCandidates(config.longitudinal, self.times)
        self.lateral = LateralCandidates(config.lateral, road, device)
        reach = config.limits.speed_max_mps * config.horizon_s
        n_stations = int(reach / config.clearance.station_m) + 1
        self.stations = torch.arange(1, n_stations + 1, device=device) * config.clearance.station_m

    @property
    def n_combinations(self) -> int:
        """Trajectories checked per vehicle and decision."""
        return self.longitudinal.n_candidates * self.lateral.n_candidates

    def plan(self, perception: Perception, horizon: Tensor) -> Motion:
        """Best feasible trajectory of every seat, given its prediction horizon [E, S] (s)."""
        shape = horizon.shape
        own, other = map_tensors(_flatten, perception.own), map_tensors(_flatten, perception.other)
        direction, desired_speed = perception.direction.flatten(), perception.desired_speed.flatten()
        route = self.road.to_route(own, direction)
        samples = self.longitudinal.sample(route, desired_speed)
        paths = self._paths(route, direction, desired_speed)
        is_feasible = self._is_drivable(samples)[:, None, :]
        is_feasible = is_feasible & (samples.travelled[:, None, :, -1] <= paths.free_distance[:, :, None])
        predicted = predict(self.config.prediction, self.road, other, direction[:, None], self.times)
        is_feasible = is_feasible & ~self._conflicts(
            route, samples, paths, predicted, other.speed, horizon.flatten(), perception.is_seen.flatten(0, 1)
        )
        cost = paths.cost[:, :, None] + self._longitudinal_cost(samples, desired_speed)[:, None, :]
        cost, best = torch.where(is_feasible, cost, torch.inf).flatten(1).min(dim=1)
        is_full_braking = torch.isinf(cost)
        following = self._follow(route, samples, paths, best)
        braking = self._brake(route, paths)
        after = RouteState(*(torch.where(is_full_braking, b, f) for b, f in zip(braking, following, strict=True)))
        state = self.road.to_world(after, direction)
        return Motion(
            map_tensors(lambda field: field.reshape(*shape, *field.shape[1:]), state),
            horizon,
            is_full_braking.reshape(shape),
        )

    def _paths(self, route: RouteState, direction: Tensor, desired_speed: Tensor) -> Paths:
        coefficients = self.lateral.start(route)
        at = self.stations[None, None]
        point = self.lateral.follow(coefficients, route.s, at)
        limits = self.config.limits
        curvature = point.bend.abs() * torch.rsqrt(1 + point.slope**2) ** 3
        allowed = (limits.lateral_accel_max_mps2 / desired_speed**2).clamp(max=limits.curvature_max_1pm)
        is_blocked = curvature > allowed[:, None, None]
        is_blocked = is_blocked | self._hits_roadside(route.s[:, None, None] + at, point.d, point.slope, direction)
        first = torch.where(is_blocked, self.stations, torch.inf).amin(-1)
        weights = self.config.cost
        bend = torch.stack(coefficients[2:]).square().sum(0)
        cost = weights.offset * self.lateral.offset**2 + weights.bend * bend
        return Paths(coefficients, first - self.config.clearance.station_m, cost)

    def _hits_roadside(self, s: Tensor, d: Tensor, slope: Tensor, direction: Tensor) -> Tensor:
        """[N, L, S] bool: the footprint, grown by the clearance, touches a parked car or a kerb."""
        size, clearance = self.vehicle, self.config.clearance.parked_m
        half_length, half_width = size.length_m / 2 + clearance, size.width_m / 2 + clearance
        cos = torch.rsqrt(1 + slope**2)
        sin = slope * cos
        parked = self.road.parked_boxes()
        own = Boxes(s[..., None], d[..., None], cos[..., None], sin[..., None], half_length, half_width)
        towards = direction[:, None, None, None]
        seen = parked._replace(x=towards * parked.x + self.road.config.corridor_length_m / 2, y=towards * parked.y)
        reach = half_length * sin.abs() + half_width * cos
        is_off_road = d.abs() + reach > self.road.config.width_m / 2
        return (overlap_depth(own, seen).amax(-1) > 0) | is_off_road

    def _is_drivable(self, samples: LongitudinalSamples) -> Tensor:
        """[N, C] bool: speed and acceleration stay within the limits at all times."""
        limits = self.config.limits
        tolerance = 0.05  # m/s: rounding and the last centimetres before standstill; executed speeds are >= 0
        is_ok = (samples.speed >= -tolerance) & (samples.speed <= limits.speed_max_mps)
        is_ok = is_ok & (samples.accel <= limits.accel_max_mps2) & (samples.accel >= -limits.decel_max_mps2)
        return is_ok.all(-1)

    def _longitudinal_cost(self, samples: LongitudinalSamples, desired_speed: Tensor) -> Tensor:
        """[N, C]"""
        weights = self.config.cost
        lag = samples.speed - desired_speed[:, None, None]
        return weights.jerk * samples.jerk.square().mean(-1) + weights.speed * lag.square().mean(-1)

    def _conflicts(
        self,
        route: RouteState,
        samples: LongitudinalSamples,
        paths: Paths,
        predicted: PredictedPath,
        predicted_speed: Tensor,
        horizon: Tensor,
        is_seen: Tensor,
    ) -> Tensor:
        """[N, L, C] bool: the footprint meets a predicted vehicle at some time within the prediction horizon.

        Vehicles that are not seen (`is_seen` [N, O]) do not count.
        """
        size, clearance = self.vehicle, self.config.clearance
        travelled = samples.travelled[:, None]  # [N, 1, C, T]
        point = self.lateral.follow(paths.coefficients, route.s, travelled)
        cos = torch.rsqrt(1 + point.slope**2)
        own = Boxes(
            (route.s[:, None, None, None] + travelled)[:, None],
            point.d[:, None],
            cos[:, None],
            (point.slope * cos)[:, None],
            size.length_m / 2,
            size.width_m / 2,
        )
        beside = size.width_m / 2 + clearance.beside_m + clearance.beside_s * predicted_speed  # [N, O]
        other_cos = torch.rsqrt(1 + predicted.slope**2)
        fields = (predicted.s, predicted.d, other_cos, predicted.slope * other_cos)  # [N, O, T] each
        s, d, cos, sin = (field[:, :, None, None, :] for field in fields)
        half_length = size.length_m / 2 + clearance.ahead_m
        other = Boxes(s, d, cos, sin, half_length, beside[:, :, None, None, None])
        is_predicted = self.times <= horizon[:, None] + self.dt_s / 2
        depth = overlap_depth(own, other)  # [N, O, L, C, T]
        counts = is_seen[:, :, None] & is_predicted[:, None]  # [N, O, T]
        return torch.where(counts[:, :, None, None], depth, -torch.inf).amax((1, -1)) > 0

    def _follow(self, route: RouteState, samples: LongitudinalSamples, paths: Paths, best: Tensor) -> RouteState:
        """State one step along the chosen combination [N] (flat index over L x C)."""
        n_longitudinal = self.longitudinal.n_candidates
        column = (best % n_longitudinal)[:, None]
        travelled, speed, accel = (field[:, :, 0].gather(1, column)[:, 0] for field in samples[:3])
        is_at_rest = speed < 1e-3
        speed = torch.where(is_at_rest, 0.0, speed)
        accel = torch.where(is_at_rest, 0.0, accel)
        return self._on_path(route, paths, best // n_longitudinal, travelled.clamp(min=0), speed, accel)

    def _brake(self, route: RouteState, paths: Paths) -> RouteState:
        """State one step into full braking, on the path that stays free the longest."""
        stretch = torch.sqrt(1 + route.d_prime**2)  # the limit holds along the path, the plan is along the road
        decel, dt = self.config.limits.full_braking_mps2 / stretch, self.dt_s
        moving_s = (route.s_dot / decel).clamp(max=dt)
        travelled = route.s_dot * moving_s - decel * moving_s**2 / 2
        speed = (route.s_dot - decel * dt).clamp(min=0)
        accel = torch.where(speed > 0, -decel, 0.0)
        return self._on_path(route, paths, paths.free_distance.argmax(1), travelled, speed, accel)

    def _on_path(
        self, route: RouteState, paths: Paths, chosen: Tensor, travelled: Tensor, speed: Tensor, accel: Tensor
    ) -> RouteState:
        all_paths = self.lateral.follow(paths.coefficients, route.s, travelled[:, None])
        point = (field.gather(1, chosen[:, None])[:, 0] for field in all_paths)
        return RouteState(route.s + travelled, speed, accel, *point)


def _flatten(field: Tensor) -> Tensor:
    return field.flatten(0, 1)
