"""Cautious driver: it follows its route and enters the corridor only if it can leave it before the other enters.

Who is nearly at rest beyond its waiting place is far from the corridor in time, but stands where nobody can pass it.
So the driver also waits for whoever is there already if it can still stop, and brakes for whoever rests in its way.
"""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from negopipe.agents.encounter import Encounter
from negopipe.agents.route_following import (
    Hindrance,
    RouteFollowingConfig,
    StopLines,
    is_on_route,
    nearest,
    resting_on_route,
)
from negopipe.schema import NonNegativeFloat, Real, schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.waiting_place import ROOM_M, Passage

LONG_S = 1e3
"""Travel time of a standing vehicle, s."""


@schema
class Config(RouteFollowingConfig):
    """`conf/evaluation/baseline/cautious.yaml` says what each value means."""

    kind: Literal["cautious"]
    stop_s_m: Real
    margin_s: NonNegativeFloat

    def hindrance(self, simulator: Simulator) -> Callable[[Perception, Encounter], Hindrance]:
        lines = StopLines(simulator, self.stop_s_m, self.gap_m)
        passage = Passage.of(simulator.collisions, simulator.sizes)

        def is_taken(perception: Perception, met: Encounter) -> Tensor:
            """[E, S] bool: another vehicle is in the passage, where it leaves too little room to pass it."""
            left_m = passage.leaving_s(met.own.s, perception.direction, perception.length) - met.own.s
            is_there = met.apart_m < left_m[..., None]
            return (is_there & is_on_route(simulator, perception, met, ROOM_M)).any(-1)

        def hindered(perception: Perception, met: Encounter) -> Hindrance:
            can_stop = lines.can_stop(met, perception.direction, self.braking_max_mps2)
            must_wait = self.must_wait(met, perception.desired_speed) | (is_taken(perception, met) & can_stop)
            line = lines.hindrance(met, must_wait, perception.direction)
            return nearest(line, resting_on_route(simulator, perception, met))

        return hindered

    def must_wait(self, met: Encounter, desired_speed: Tensor) -> Tensor:
        """[E, S] bool: another vehicle could enter the narrow place before the agent has left it."""
        own_s = time_to(met.narrow_m + met.own_m[..., 0] / 2, met.own_s, (met.own.s_dot + desired_speed) / 2)
        other_s = time_to(-met.other_m / 2, met.other_s, met.other_speed)
        return (met.is_oncoming & (other_s < own_s[..., None] + self.margin_s)).any(-1)


def time_to(s_m: float | Tensor, now_m: Tensor, speed: Tensor) -> Tensor:
    """Travel time to a place at constant speed, s; 0 where the place is behind, `LONG_S` at most."""
    left = (s_m - now_m).clamp(min=0)
    return torch.where(left > 0, (left / speed.clamp(min=1e-3)).clamp(max=LONG_S), 0.0)
