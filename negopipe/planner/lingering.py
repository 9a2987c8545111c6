"""Lingering: a plan that would keep a vehicle in the passage while an oncoming one comes.

In the passage nobody can be passed. Who creeps into it, or comes to rest there, stands in the way of the one that it
predicts to come, and two that do so stand nose to nose. Such a plan costs more than to wait where the other can pass.
"""

from torch import Tensor

from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.state import VehicleState
from negopipe.simulation.waiting_place import Passage

ROUNDING_M = 0.02
"""Distance by which a stop may miss its place, m."""


class Lingering:
    """The passage of one road; N vehicles that plan, O others."""

    def __init__(self, road: Road, passage: Passage, plan_s: float) -> None:
        self.road, self.passage, self._plan_s = road, passage, plan_s

    def is_met(
        self, route: RouteState, direction: Tensor, horizon: Tensor, other: VehicleState, is_seen: Tensor
    ) -> Tensor:
        """[N] bool: at its present speed an oncoming vehicle ahead is in the passage within the prediction horizon.

        route: fields [N]; direction, horizon: [N], +1 or -1 and s; other: fields [O, N]; is_seen: [O, N] bool
        """
        its_direction = self.road.direction_of(other, direction)
        its = self.road.to_route(other, its_direction)
        is_ahead = its.s < self.road.corridor_m(direction) - route.s
        comes = is_seen & (its_direction != direction) & is_ahead & (horizon > 0)
        to_passage = self.passage.at(self.passage.their_waiting, route.s, direction) - its.s
        seconds = horizon.clamp(max=self._plan_s)  # nothing is predicted beyond the plan
        return (comes & (to_passage <= its.s_dot * seconds)).any(0)

    def lingers(self, travelled: Tensor, speed: Tensor, route: RouteState, direction: Tensor, is_met: Tensor) -> Tensor:
        """[C, N] bool: candidates, `travelled` and `speed` [C, T, N], that end in the passage, too slow to leave soon.

        Soon is within another planning horizon at the speed of their end.
        """
        end, end_speed = travelled[:, -1], speed[:, -1].clamp(min=0)
        is_in = end > self.passage.waiting_s(route.s, direction) - route.s + ROUNDING_M
        stays = end + end_speed * self._plan_s < self.passage.leaving_s(route.s, direction) - route.s
        return is_met & is_in & stays
