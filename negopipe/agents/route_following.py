"""Driving along the own route at the speed of the Intelligent Driver Model (Treiber et al. 2000), without a planner.

What stands in the way is a `Hindrance`: a vehicle ahead, an oncoming vehicle in the corridor, a line to wait at. The
drivers that follow their route differ in which hindrances they heed.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.agents.driver_config import MotionRule
from negopipe.agents.encounter import Encounter, encounter
from negopipe.schema import NonNegativeMetres, PositiveFloat, schema
from negopipe.simulation.collisions import PASSING_M
from negopipe.simulation.perception import Perception
from negopipe.simulation.road import RouteState
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import AT_REST_MPS, Motion
from negopipe.simulation.waiting_place import ROOM_M, waiting_places
from negopipe.tensors.tree import map_tensors

FREE_M = 1e3
"""Gap of a vehicle without an obstacle ahead, m."""
LEAST_GAP_M = 0.1
"""Smallest gap by which the model divides, m."""
CLOSE_M = 0.1
"""Room on either side of a vehicle at rest that is too little to pass it, m."""


@schema
class RouteFollowingConfig(MotionRule):
    """Parameters of the Intelligent Driver Model; `conf/evaluation/baseline/idm.yaml` says what each value means."""

    accel_mps2: PositiveFloat
    decel_mps2: PositiveFloat
    braking_max_mps2: PositiveFloat
    gap_m: NonNegativeMetres
    headway_s: PositiveFloat

    def rule(self, simulator: Simulator) -> Callable[[Perception], Motion]:
        hindered = self.hindrance(simulator)

        def drive(perception: Perception) -> Motion:
            met = encounter(simulator.road, perception)
            hindrance = nearest(hindered(perception, met), vehicle_ahead(met))
            return follow_route(simulator, self, perception, met.own, hindrance)

        return drive

    def hindrance(self, simulator: Simulator) -> "Callable[[Perception, Encounter], Hindrance]":
        """The hindrance that this kind of driver heeds beside a vehicle ahead of it."""
        raise NotImplementedError


class Hindrance(NamedTuple):
    """An obstacle ahead: gap_m [E, S], distance to it; closing_mps [E, S], rate at which the gap shrinks."""

    gap_m: Tensor
    closing_mps: Tensor


def follow_route(
    simulator: Simulator, config: RouteFollowingConfig, perception: Perception, now: RouteState, hindrance: Hindrance
) -> Motion:
    """Motion of S agents on their routes in the next control step."""
    return along_route(simulator, perception, now, idm(config, now.s_dot, perception.desired_speed, hindrance))


def along_route(simulator: Simulator, perception: Perception, now: RouteState, accel: Tensor) -> Motion:
    """Motion of S agents on their routes in the next control step with accelerations [E, S] (m/s2), never backwards."""
    road, dt_s = simulator.road, simulator.scenario.dt_s
    speed = now.s_dot + dt_s * accel
    speed = speed.clamp(min=0)
    s = now.s + (now.s_dot + speed) / 2 * dt_s
    route = RouteState(s, speed, (speed - now.s_dot) / dt_s, *road.route_offset(s, perception.direction))
    no_horizon, no = torch.full_like(s, torch.nan), torch.zeros_like(s, dtype=torch.bool)
    return Motion(road.to_world(route, perception.direction), no_horizon, no)


def idm(config: RouteFollowingConfig, speed: Tensor, desired_speed: Tensor, hindrance: Hindrance) -> Tensor:
    """Acceleration [E, S], m/s2 (Treiber et al. 2000, Eq. 2 and 3)."""
    braking = speed * hindrance.closing_mps / (2 * (config.accel_mps2 * config.decel_mps2) ** 0.5)
    wanted_gap = config.gap_m + (speed * config.headway_s + braking).clamp(min=0)
    share = (speed / desired_speed.clamp(min=0.1)) ** 4
    accel = config.accel_mps2 * (1 - share - (wanted_gap / hindrance.gap_m.clamp(min=LEAST_GAP_M)) ** 2)
    return accel.clamp(min=-config.braking_max_mps2)


def vehicle_ahead(met: Encounter) -> Hindrance:
    """The nearest vehicle that drives ahead in the same direction."""
    return _nearest_of(met, met.is_ahead, met.other_s - met.own_s[..., None] - met.touch_m, -met.other_speed)


def nose_to_nose(met: Encounter) -> Hindrance:
    """The nearest oncoming vehicle, where both have their fronts in the corridor."""
    is_inside = (met.own_s[..., None] > -met.own_m / 2) & (met.other_s > -met.other_m / 2)
    in_the_way = met.is_oncoming & is_inside & (met.apart_m > 0)
    return _nearest_of(met, in_the_way, met.apart_m - met.touch_m, met.other_speed)


def on_route(simulator: Simulator, perception: Perception, met: Encounter) -> Hindrance:
    """The nearest oncoming vehicle that is on the own route now, or is nose to nose in the corridor."""
    in_the_way = is_on_route(simulator, perception, met, PASSING_M)
    on_it = _nearest_of(met, in_the_way, met.apart_m - met.touch_m, met.other_speed)
    return nearest(on_it, nose_to_nose(met))


def resting_on_route(simulator: Simulator, perception: Perception, met: Encounter) -> Hindrance:
    """The nearest oncoming vehicle that rests on the own route, or is nose to nose in the corridor."""
    rests = met.other_speed.abs() < AT_REST_MPS
    in_the_way = rests & is_on_route(simulator, perception, met, CLOSE_M)
    on_it = _nearest_of(met, in_the_way, met.apart_m - met.touch_m, met.other_speed)
    return nearest(on_it, nose_to_nose(met))


def is_on_route(simulator: Simulator, perception: Perception, met: Encounter, room_m: float) -> Tensor:
    """[E, S, O] bool: oncoming vehicles ahead that an agent on its route cannot pass where they are now.

    room_m: that it needs on either side
    """
    sizes, shape = simulator.sizes, met.apart_m.shape
    others = map_tensors(lambda field: field.flatten(0, 1), perception.other)
    direction = perception.direction.flatten()[:, None]
    size = sizes.of(perception.other_length.flatten(0, 1), perception.other_width.flatten(0, 1))
    own = sizes.of(perception.length.flatten()[:, None], perception.width.flatten()[:, None])
    stands_on_route = simulator.collisions.stands_on_route(others, size, direction, own, room_m)
    return met.is_oncoming & stands_on_route.reshape(shape) & (met.apart_m > 0)


class StopLines:
    """Lines before the narrow places of a road at which vehicles come to rest that let the others through.

    A vehicle that is longer than the ego has its front where that of the ego would be.

    stop_s_m: place of a line behind the mouth; where the other cannot pass there, the next place before it is taken
    gap_m: gap that the driver keeps
    """

    def __init__(self, simulator: Simulator, stop_s_m: float, gap_m: float) -> None:
        self._road, self._gap_m = simulator.road, gap_m
        self._ends = simulator.road.narrow_places[..., 1]
        self._sizes = simulator.sizes
        self._wanted, self._latest = (
            waiting_places(simulator.collisions, self._sizes, latest_m, room_m)
            for latest_m, room_m in ((stop_s_m, ROOM_M), (0.0, PASSING_M))
        )

    def hindrance(self, met: Encounter, must_wait: Tensor, direction: Tensor) -> Hindrance:
        """The line of agents that `must_wait` [E, S]; it counts also past it, as long as the other can still pass."""
        latest_m, wanted_m = (self._left_m(each, met, direction) for each in (self._latest, self._wanted))
        can_wait = latest_m > -LEAST_GAP_M
        return Hindrance(torch.where(must_wait & can_wait, wanted_m + self._gap_m, FREE_M), met.own.s_dot)

    def can_stop(self, met: Encounter, direction: Tensor, decel_mps2: float) -> Tensor:
        """[E, S] bool: with this deceleration an agent comes to rest where the others can still pass it."""
        return met.own.s_dot**2 / (2 * decel_mps2) < self._left_m(self._latest, met, direction)

    def _left_m(self, places: Tensor, met: Encounter, direction: Tensor) -> Tensor:
        """[E, S] m: distance of agents to places of `waiting_places`."""
        s = met.own.s + self._sizes.longer_m(met.own_m[..., 0])
        return self._road.of_place(places, self._ends, s, direction) - s


def nearest(a: Hindrance, b: Hindrance) -> Hindrance:
    """The nearer one of two hindrances, world by world."""
    is_a = a.gap_m <= b.gap_m
    return Hindrance(*(torch.where(is_a, of_a, of_b) for of_a, of_b in zip(a, b, strict=True)))


def _nearest_of(met: Encounter, is_counted: Tensor, gap_m: Tensor, approaching_mps: Tensor) -> Hindrance:
    """The nearest of those others that count; gaps, and their speeds towards the agent, [E, S, O]."""
    gap, which = torch.where(is_counted, gap_m, FREE_M).min(-1, keepdim=True)
    return Hindrance(gap[..., 0], met.own.s_dot + approaching_mps.gather(-1, which)[..., 0])
