"""Interface of the baselines, the planners that the policy is compared with."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar

from torch import Tensor

from negopipe.agents.driver import Driver
from negopipe.checks import Problem, check_horizons, check_times
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
    def prediction_horizons_s(self) -> dict[str, tuple[float, ...]]:
        """Prediction horizons that its driver may use, by the name of the field."""
        return {}

    @property
    def times_s(self) -> dict[str, float]:
        """Times that must be whole control steps, s, by the name of the field."""
        return {}

    def check(self, key: str, dt_s: float, plan_s: float) -> Iterator[Problem]:
        """key: of this baseline; plan_s: length of a plan."""
        horizons_s = {f"{key}.{name}": values for name, values in self.prediction_horizons_s.items()}
        yield from check_horizons(horizons_s, dt_s, plan_s)
        yield from check_times({f"{key}.{name}": (time_s,) for name, time_s in self.times_s.items()}, dt_s)

    @property
    def fixed_horizon_s(self) -> float | None:
        """The one horizon of all its decisions, s; None where it has several or none."""
        return None

    @abstractmethod
    def driver(self, game: Game, episode_key: Tensor) -> Driver:
        """Driver for a batch of episodes that start together.

        episode_key: [E] int64, key of the random draws in each episode
        """
