"""Cautious driver: it follows its route and enters the corridor only if it can leave it before the other enters.

Its speed is that of the Intelligent Driver Model (Treiber et al. 2000). It plans no path.
"""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from negopipe.agents.baseline import Baseline
from negopipe.agents.encounter import Encounter, encounter
from negopipe.game.game import Game
from negopipe.schema import NonNegativeFloat, NonNegativeMetres, PositiveFloat, Real, schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.road import RouteState
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import Motion
from negopipe.simulation.waiting_place import waiting_place

FREE_M = 1e3
"""Gap of a vehicle without an obstacle ahead, m."""
LEAST_GAP_M = 0.1
"""Smallest gap by which the model divides, m."""
LONG_S = 1e3
"""Travel time of a standing vehicle, s."""


@schema
class Config(Baseline):
    """`conf/evaluation/baseline/cautious.yaml` says what each value means."""

    kind: Literal["cautious"]
    stop_s_m: Real
    margin_s: NonNegativeFloat
    accel_mps2: PositiveFloat
    decel_mps2: PositiveFloat
    braking_max_mps2: PositiveFloat
    gap_m: NonNegativeMetres
    headway_s: PositiveFloat

    def driver(self, game: Game, episode_key: Tensor) -> "CautiousDriver":
        return CautiousDriver(game, self)


class Hindrance(NamedTuple):
    """An obstacle ahead: gap_m [E, 1], distance to it; closing_mps [E, 1], rate at which the gap shrinks."""

    gap_m: Tensor
    closing_mps: Tensor


class CautiousDriver:
    """Driver that follows its route at the speed of the Intelligent Driver Model."""

    def __init__(self, game: Game, config: Config) -> None:
        self.road, self.dt_s, self.config = game.simulator.road, game.simulator.scenario.dt_s, config
        self.length_m = game.simulator.scenario.vehicle.length_m
        self._waiting_m = _by_direction(game.simulator, config.stop_s_m)
        self._latest_m = _by_direction(game.simulator, 0.0)

    def drive(self, perception: Perception) -> Motion:
        met = encounter(self.road, self.length_m, perception)
        stop_line = self.stop_line(met, perception.direction, perception.desired_speed)
        hindrance = nearest(stop_line, self.nose_to_nose(met))
        now = met.own
        speed = now.s_dot + self.dt_s * idm(self.config, now.s_dot, perception.desired_speed, hindrance)
        speed = speed.clamp(min=0)
        s = now.s + (now.s_dot + speed) / 2 * self.dt_s
        route = RouteState(s, speed, (speed - now.s_dot) / self.dt_s, *self.road.route_offset(s, perception.direction))
        no_horizon, no = torch.full_like(s, torch.nan), torch.zeros_like(s, dtype=torch.bool)
        return Motion(self.road.to_world(route, perception.direction), no_horizon, no)

    def stop_line(self, met: Encounter, direction: Tensor, desired_speed: Tensor) -> Hindrance:
        """The stop line before the corridor; it counts while another vehicle could enter before the ego has left."""
        through_m = self.road.config.corridor_length_m + self.length_m / 2
        own_s = time_to(through_m, met.own.s, (met.own.s_dot + desired_speed) / 2)
        other_s = time_to(-self.length_m / 2, met.other_s, met.other_speed)
        must_wait = (met.is_oncoming & (other_s < own_s[..., None] + self.config.margin_s)).any(-1)
        is_along = (direction > 0).long()
        can_wait = (
            met.own.s < self._latest_m[is_along] + LEAST_GAP_M
        )  # also past the line, as long as the other can pass
        left = self._waiting_m[is_along] - met.own.s
        gap = torch.where(must_wait & can_wait, left + self.config.gap_m, FREE_M)
        return Hindrance(gap, met.own.s_dot)

    def nose_to_nose(self, met: Encounter) -> Hindrance:
        """The nearest oncoming vehicle, where both have their fronts in the corridor."""
        is_inside = (met.own.s[..., None] > -self.length_m / 2) & (met.other_s > -self.length_m / 2)
        in_the_way = met.is_oncoming & is_inside & (met.apart_m > 0)
        gap, which = torch.where(in_the_way, met.apart_m - self.length_m, FREE_M).min(-1, keepdim=True)
        return Hindrance(gap[..., 0], met.own.s_dot + met.other_speed.gather(-1, which)[..., 0])


def _by_direction(simulator: Simulator, latest_s_m: float) -> Tensor:
    """[2] float32: waiting places of vehicles that drive against the line and along it, m."""
    places = [waiting_place(simulator.collisions, latest_s_m, direction) for direction in (-1.0, 1.0)]
    return torch.tensor(places, device=simulator.road.parked_cars.device)


def nearest(a: Hindrance, b: Hindrance) -> Hindrance:
    """The nearer one of two hindrances, world by world."""
    is_a = a.gap_m <= b.gap_m
    return Hindrance(*(torch.where(is_a, of_a, of_b) for of_a, of_b in zip(a, b, strict=True)))


def idm(config: Config, speed: Tensor, desired_speed: Tensor, hindrance: Hindrance) -> Tensor:
    """Acceleration [E, 1], m/s2 (Treiber et al. 2000, Eq. 2 and 3)."""
    braking = speed * hindrance.closing_mps / (2 * (config.accel_mps2 * config.decel_mps2) ** 0.5)
    wanted_gap = config.gap_m + (speed * config.headway_s + braking).clamp(min=0)
    share = (speed / desired_speed.clamp(min=0.1)) ** 4
    accel = config.accel_mps2 * (1 - share - (wanted_gap / hindrance.gap_m.clamp(min=LEAST_GAP_M)) ** 2)
    return accel.clamp(min=-config.braking_max_mps2)


def time_to(s_m: float, now_m: Tensor, speed: Tensor) -> Tensor:
    """Travel time to a place at constant speed, s; 0 where the place is behind, `LONG_S` at most."""
    left = (s_m - now_m).clamp(min=0)
    return torch.where(left > 0, (left / speed.clamp(min=1e-3)).clamp(max=LONG_S), 0.0)
