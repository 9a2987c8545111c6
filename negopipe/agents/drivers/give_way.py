"""Give way: the vehicle that is farther from the corridor lets the other through first.

The planner gives way with a long prediction horizon and goes first with a short one.
"""

from typing import Literal

import torch
from torch import Tensor

from negopipe.agents.driver import ChooseHorizon
from negopipe.agents.driver_config import HorizonRule
from negopipe.agents.encounter import encounter
from negopipe.schema import Horizon, schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator


@schema
class Config(HorizonRule):
    """`conf/evaluation/baseline/give_way.yaml` says what each value means."""

    kind: Literal["give_way"]
    waiting_horizon_s: Horizon
    going_horizon_s: Horizon

    @property
    def prediction_horizons_s(self) -> dict[str, tuple[float, ...]]:
        return {"waiting_horizon_s": (self.waiting_horizon_s,), "going_horizon_s": (self.going_horizon_s,)}

    def choose(self, simulator: Simulator) -> ChooseHorizon:
        road = simulator.road

        def by_distance(perception: Perception) -> Tensor:
            met = encounter(road, perception)
            is_nearer = met.other_s >= met.own_s[..., None]  # at equal distances both wait
            must_wait = (met.is_oncoming & is_nearer).any(-1)
            return torch.where(must_wait, self.waiting_horizon_s, self.going_horizon_s)

        return by_distance
