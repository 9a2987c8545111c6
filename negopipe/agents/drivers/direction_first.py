"""Direction first: one driving direction goes first through the corridor, whoever arrives first.

In 209 filmed encounters at a narrowing the driving direction decided more than the order of arrival who went first
(Quante et al. 2023). Where cars are parked on one side only, many traffic rules make that side wait.
"""

from collections.abc import Callable
from typing import Literal

from torch import Tensor

from negopipe.agents.encounter import Encounter
from negopipe.agents.route_following import (
    Hindrance,
    RouteFollowingConfig,
    nearest,
    nose_to_nose,
    stop_line,
    waiting_places,
)
from negopipe.schema import Real, schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import AT_REST_MPS

SIDE_OF_DIRECTION = {"right": 1.0, "left": -1.0}
"""Side of the street on which a vehicle drives, seen along the line -> its direction; vehicles keep right."""


@schema
class Config(RouteFollowingConfig):
    """`conf/evaluation/baseline/direction_first.yaml` says what each value means."""

    kind: Literal["direction_first"]
    first: Literal["along", "against", "free_side"]
    stop_s_m: Real

    def hindrance(self, simulator: Simulator) -> Callable[[Perception, Encounter], Hindrance]:
        length_m, first = simulator.scenario.vehicle.length_m, self.first_direction(simulator.road.config.parked_sides)
        places = waiting_places(simulator, self.stop_s_m)

        def hindered(perception: Perception, met: Encounter) -> Hindrance:
            must_wait = (perception.direction != first) & _is_met(met, length_m)
            line = stop_line(met, must_wait, places, self.gap_m, perception.direction)
            return nearest(line, nose_to_nose(met, length_m))

        return hindered

    def first_direction(self, parked_sides: str) -> float:
        """The direction that goes first: +1 along the line, -1 against it."""
        if self.first == "free_side" and parked_sides in SIDE_OF_DIRECTION:
            return -SIDE_OF_DIRECTION[parked_sides]
        return -1.0 if self.first == "against" else 1.0


def _is_met(met: Encounter, length_m: float) -> Tensor:
    """[E, S] bool: an oncoming vehicle has not passed yet and does not stand before its mouth of the corridor."""
    stands_aside = (met.other_speed.abs() < AT_REST_MPS) & (met.other_s < -length_m / 2)
    return (met.is_oncoming & ~stands_aside).any(-1)
