"""Giving way: the rule of an infinite prediction horizon, which sees an encounter to its end.

A vehicle is in the passage between the last place before the corridor and the first place behind it at which the other
can pass it. The speed of an oncoming vehicle may be anything between what it is now and what it could reach. A plan may
enter the passage only if it has left it before the other could enter, or after the other has surely left.
"""

import torch
from torch import Tensor

from negopipe.planner.situation import Situation
from negopipe.schema import NonNegativeFloat, PositiveFloat, schema
from negopipe.simulation.waiting_place import Passage

NEVER_S = 1e6
"""Time of what never happens, s."""
SLOWEST_MPS = 0.1
"""Speed below which a vehicle is not expected to get anywhere, m/s."""
ROUNDING_M = 0.02
"""Distance by which a stop may miss its place, m."""


@schema
class GiveWayConfig:
    """Assumptions on an oncoming vehicle.

    accel_mps2, speed_max_mps: acceleration and highest speed of the earliest entry
    margin_s: time between the one's leaving the passage and the other's entering
    """

    accel_mps2: PositiveFloat
    speed_max_mps: PositiveFloat
    margin_s: NonNegativeFloat


class GiveWay:
    """The rule on one road; places are those of centres, for both driving directions."""

    def __init__(self, config: GiveWayConfig, passage: Passage, times: Tensor) -> None:
        self.config, self.passage = config, passage
        self._dt_s, self._plan_s = float(times[0]), float(times[-1])

    def to_passage(self, now: Situation) -> Tensor:
        """[N] m: distance to the passage, negative behind its beginning."""
        return self.passage.waiting_s(now.route.s, now.direction, now.size.length) - now.route.s

    def times_of_others(self, now: Situation) -> tuple[Tensor, Tensor]:
        """[O, N] s: earliest time at which an oncoming vehicle enters the passage, latest at which it has left it.

        A vehicle that does not come along never enters, and has left.
        """
        passage, its, length = self.passage, now.others.route, now.others.size.length
        leaves_after = passage.their_leaving_s(now.route.s, now.direction, length) - its.s
        comes = now.others.is_oncoming & (leaves_after > 0)
        enters_after = (passage.their_waiting_s(now.route.s, now.direction, length) - its.s).clamp(min=0)
        latest = torch.where(its.s_dot > SLOWEST_MPS, leaves_after / its.s_dot.clamp(min=SLOWEST_MPS), NEVER_S)
        earliest = self._soonest(enters_after, its.s_dot)
        return torch.where(comes, earliest, NEVER_S), torch.where(comes, latest, -NEVER_S)

    def _soonest(self, distance: Tensor, speed: Tensor) -> Tensor:
        """Time to a place at full acceleration up to the highest speed, s."""
        accel, fastest = self.config.accel_mps2, speed.clamp(min=self.config.speed_max_mps)
        gaining_s = (fastest - speed) / accel
        gaining_m = gaining_s * (speed + fastest) / 2
        within = (torch.sqrt(speed**2 + 2 * accel * distance) - speed) / accel
        return torch.where(distance < gaining_m, within, gaining_s + (distance - gaining_m) / fastest)

    def allows(self, travelled: Tensor, speed: Tensor, now: Situation, others: tuple[Tensor, Tensor]) -> Tensor:
        """[C, N] bool: candidates, `travelled` and `speed` [C, T, N], that keep the rule.

        Who is in the passage already is not held up by it.

        others: of `times_of_others`
        """
        to_passage, earliest, latest = self.to_passage(now), *others
        through = self.passage.leaving_s(now.route.s, now.direction, now.size.length) - now.route.s
        end, end_speed = travelled[:, -1], speed[:, -1].clamp(min=SLOWEST_MPS)
        enters_s = (travelled <= to_passage + ROUNDING_M).sum(1) * self._dt_s
        within_s = ((travelled < through).sum(1) + 1) * self._dt_s
        leaves_s = torch.where(end >= through, within_s, self._plan_s + (through - end) / end_speed)
        stays_out = (end <= to_passage + ROUNDING_M) | (to_passage < -ROUNDING_M)
        margin_s = self.config.margin_s
        is_first = leaves_s[:, None] + margin_s < earliest  # [C, O, N]
        is_after = enters_s[:, None] > latest + margin_s
        return stays_out | (is_first | is_after).all(1)
