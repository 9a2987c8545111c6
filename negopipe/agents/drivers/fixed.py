"""Fixed horizon: the same prediction horizon at every decision, as the baselines of the paper."""

from typing import Literal

from negopipe.agents.driver import ChooseHorizon, fixed_horizon
from negopipe.agents.driver_config import HorizonRule
from negopipe.schema import Horizon, schema
from negopipe.simulation.simulator import Simulator


@schema
class Config(HorizonRule):
    """A fixed horizon.

    horizon_s: time for which the other is predicted; 0 = it is ignored
    """

    kind: Literal["fixed"]
    horizon_s: Horizon

    @property
    def prediction_horizons_s(self) -> dict[str, tuple[float, ...]]:
        return {"horizon_s": (self.horizon_s,)}

    @property
    def fixed_horizon_s(self) -> float:
        return self.horizon_s

    def choose(self, simulator: Simulator) -> ChooseHorizon:
        return fixed_horizon(self.horizon_s)
