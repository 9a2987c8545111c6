"""Fixed horizon: the same prediction horizon at every decision, as the baselines of the paper."""

from typing import Literal

from torch import Tensor

from negopipe.agents.baseline import Baseline
from negopipe.agents.driver import HorizonDriver, fixed_horizon
from negopipe.game.game import Game
from negopipe.schema import NonNegativeFloat, schema


@schema
class Config(Baseline):
    """A fixed horizon.

    horizon_s: time for which the other is predicted; 0 = it is ignored
    """

    kind: Literal["fixed"]
    horizon_s: NonNegativeFloat

    @property
    def prediction_horizons_s(self) -> dict[str, tuple[float, ...]]:
        return {"horizon_s": (self.horizon_s,)}

    @property
    def fixed_horizon_s(self) -> float:
        return self.horizon_s

    def driver(self, game: Game, episode_key: Tensor) -> HorizonDriver:
        return HorizonDriver(fixed_horizon(self.horizon_s), game.plan)
