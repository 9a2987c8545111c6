"""Lingering: a plan that would keep a vehicle in the passage while an oncoming one comes.

In the passage nobody can be passed. Who creeps into it, or comes to rest there, stands in the way of the one that it
predicts to come, and two that do so stand nose to nose. Such a plan costs more than to wait where the other can pass.
"""

from torch import Tensor

from negopipe.planner.situation import Situation
from negopipe.simulation.waiting_place import Passage

ROUNDING_M = 0.02
"""Distance by which a stop may miss its place, m."""


class Lingering:
    """The passages of a road; N vehicles that plan, O others."""

    def __init__(self, passage: Passage, plan_s: float) -> None:
        self.passage, self._plan_s = passage, plan_s

    def is_met(self, now: Situation) -> Tensor:
        """[N] bool: at its present speed an oncoming vehicle ahead is in the passage within the prediction horizon."""
        passage, others = self.passage, now.others
        comes = others.is_oncoming & (others.s > now.route.s) & (now.horizon > 0)
        to_passage = passage.their_waiting_s(now.route.s, now.direction, others.size.length) - others.route.s
        seconds = now.horizon.clamp(max=self._plan_s)  # nothing is predicted beyond the plan
        return (comes & (to_passage <= others.route.s_dot * seconds)).any(0)

    def lingers(self, travelled: Tensor, speed: Tensor, now: Situation, is_met: Tensor) -> Tensor:
        """[C, N] bool: candidates, `travelled` and `speed` [C, T, N], that end in the passage, too slow to leave soon.

        Soon is within another planning horizon at the speed of their end.

        is_met: of `is_met`
        """
        s, length, end, end_speed = now.route.s, now.size.length, travelled[:, -1], speed[:, -1].clamp(min=0)
        is_in = end > self.passage.waiting_s(s, now.direction, length) - s + ROUNDING_M
        stays = end + end_speed * self._plan_s < self.passage.leaving_s(s, now.direction, length) - s
        return is_met & is_in & stays
