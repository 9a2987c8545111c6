"""Interface of the baselines, the planners that the policy is compared with."""

from abc import ABC, abstractmethod
from typing import ClassVar

from torch import Tensor

from negopipe.agents.driver import Driver
from negopipe.game.game import Game
from negopipe.schema import PositiveInt, schema


@schema
class Baseline(ABC):
    """Config of a baseline, which makes its driver.

    Each has a file in `negopipe.agents.baselines` and one in `conf/evaluation/baseline`.

    n_episodes: number of the evaluation's tasks that it drives, from the first on; null = all of them
    """

    n_episodes: PositiveInt | None

    is_lockstep: ClassVar[bool] = False
    """Whether its driver is asked for all worlds of a batch at every decision, in their order."""

    @property
    def horizons_s(self) -> tuple[float, ...]:
        """Prediction horizons that it may choose, s."""
        return ()

    @property
    def times_s(self) -> dict[str, float]:
        """Times that must be whole control steps, s, by the name of the field."""
        return {}

    @property
    def fixed_horizon_s(self) -> float | None:
        """The one horizon of all its decisions, s; None where it has several or none."""
        return None

    @abstractmethod
    def driver(self, game: Game, episode_key: Tensor) -> Driver:
        """Driver for a batch of episodes that start together.

        episode_key: [E] int64, key of the random draws in each episode
        """
