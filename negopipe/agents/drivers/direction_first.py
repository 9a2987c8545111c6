"""Direction first: one driving direction goes first through the corridor, whoever arrives first.

In 209 filmed encounters at a narrowing the driving direction decided more than the order of arrival who went first
(Quante et al. 2023). Where cars are parked on one side only, many traffic rules make that side wait.
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
    nearest,
    resting_on_route,
)
from negopipe.schema import Real, schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import AT_REST_MPS


@schema
class Config(RouteFollowingConfig):
    """`conf/evaluation/baseline/direction_first.yaml` says what each value means."""

    kind: Literal["direction_first"]
    first: Literal["along", "against", "free_side"]
    stop_s_m: Real

    def hindrance(self, simulator: Simulator) -> Callable[[Perception, Encounter], Hindrance]:
        road = simulator.road
        first = torch.tensor([self.first_way(cars) for cars in road.parked_on_line], device=road.device)
        lines = StopLines(simulator, self.stop_s_m, self.gap_m)

        def hindered(perception: Perception, met: Encounter) -> Hindrance:
            must_wait = (road.sign(perception.direction) != road.pick(first, perception.direction)) & _is_met(met)
            line = lines.hindrance(met, must_wait, perception.direction)
            return nearest(line, resting_on_route(simulator, perception, met))

        return hindered

    def first_way(self, parked: list[tuple[float, float, float, float]]) -> float:
        """The way that goes first on a street with cars at (sigma, d, ...): +1 along the line, -1 against it."""
        is_left_free = all(d < 0 for _, d, *_ in parked)
        return -1.0 if self.first == "against" or (self.first == "free_side" and is_left_free) else 1.0


def _is_met(met: Encounter) -> Tensor:
    """[E, S] bool: an oncoming vehicle has not passed yet and does not stand before its mouth of the corridor."""
    stands_aside = (met.other_speed.abs() < AT_REST_MPS) & (met.other_s < -met.other_m / 2)
    return (met.is_oncoming & ~stands_aside).any(-1)
