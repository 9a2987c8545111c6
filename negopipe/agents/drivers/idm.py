"""Intelligent Driver Model: it follows its route, brakes for whoever stands in it, and negotiates with nobody."""

from collections.abc import Callable
from typing import Literal

from negopipe.agents.encounter import Encounter
from negopipe.agents.route_following import Hindrance, RouteFollowingConfig, on_route
from negopipe.schema import schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator


@schema
class Config(RouteFollowingConfig):
    """`conf/evaluation/baseline/idm.yaml` says what each value means."""

    kind: Literal["idm"]

    def hindrance(self, simulator: Simulator) -> Callable[[Perception, Encounter], Hindrance]:
        return lambda perception, met: on_route(simulator, perception, met)
