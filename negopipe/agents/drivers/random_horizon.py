"""Random horizon: drawn anew every so often, whatever the other does; a trained policy must be better."""

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from negopipe.agents.driver import HorizonDriver
from negopipe.agents.driver_config import DriverConfig
from negopipe.agents.horizon_drivers import sequence_planner
from negopipe.schema import Horizon, PositiveFloat, schema
from negopipe.tensors.stateless_rng import mix

if TYPE_CHECKING:
    from negopipe.game.game import Game


@schema
class Config(DriverConfig):
    """A random horizon.

    horizons_s: s, each equally likely
    keep_s: time for which a horizon is kept
    """

    kind: Literal["random"]
    horizons_s: Annotated[tuple[Horizon, ...], Field(min_length=1)]
    keep_s: PositiveFloat

    is_lockstep: ClassVar[bool] = True

    @property
    def prediction_horizons_s(self) -> dict[str, tuple[float, ...]]:
        return {"horizons_s": self.horizons_s}

    @property
    def times_s(self) -> dict[str, float]:
        return {"keep_s": self.keep_s}

    def driver(self, game: "Game", episode_key: Tensor) -> HorizonDriver:
        scenario = game.simulator.scenario
        n_kept = round(self.keep_s / scenario.dt_s)
        draw = torch.arange(scenario.episode_steps, device=episode_key.device) // n_kept
        choice = mix(mix(mix(episode_key)) + draw[:, None]) % len(self.horizons_s)
        return HorizonDriver(
            sequence_planner(torch.tensor(self.horizons_s, device=episode_key.device)[choice]), game.plan
        )
