"""The planners that the policy is compared with: what each of them has to be."""

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
    """A config that makes the driver it describes. Each stands in a file of `negopipe.agents.baselines`, and is
    chosen by one of `conf/evaluation/baseline`.

    n_episodes: it drives the first so many of the evaluation's tasks; null = all of them
    """

    n_episodes: PositiveInt | None

    is_lockstep: ClassVar[bool] = False
    """Its driver is asked for all worlds of a batch at every decision, in their order."""

    @property
    def prediction_horizons_s(self) -> dict[str, tuple[float, ...]]:
        """Prediction horizons that its driver may use, by the name of the field."""
        return {}

    @property
    def times_s(self) -> dict[str, float]:
        """Its times that are counted in control steps, by the name of the field."""
        return {}

    def check(self, key: str, dt_s: float, plan_s: float) -> Iterator[Problem]:
        """key: of this baseline; plan_s: length of a plan."""
        horizons_s = {f"{key}.{name}": values for name, values in self.prediction_horizons_s.items()}
        yield from check_horizons(horizons_s, dt_s, plan_s)
        yield from check_times({f"{key}.{name}": (time_s,) for name, time_s in self.times_s.items()}, dt_s)

    @property
    def fixed_horizon_s(self) -> float | None:
        """The horizon that it keeps to at every decision; None where it keeps to none."""
        return None

    @abstractmethod
    def driver(self, game: Game, episode_key: Tensor) -> Driver:
        """The driver for a batch of episodes that start together.

        episode_key: [E] int64, one per episode, from which what is random may be drawn
        """
