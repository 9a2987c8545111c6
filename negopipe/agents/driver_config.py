"""Interface of the drivers' configs: a config makes its driver, as a baseline of the ego or as a social driver."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from negopipe.agents.driver import ChooseHorizon, Driver, HorizonDriver
from negopipe.checks import Foresight, Problem, check_horizons, check_times
from negopipe.schema import schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import Motion

if TYPE_CHECKING:
    from negopipe.game.game import Game


@schema
class DriverConfig(ABC):
    """Config of a driver. Each kind has a file in `negopipe.agents.drivers`."""

    is_lockstep: ClassVar[bool] = False
    """Whether its driver is asked for all worlds of a batch at every decision, in their order."""

    @property
    def n_driven(self) -> int | None:
        """Number of an evaluation's tasks that it drives as a baseline, from the first on; None = all of them."""
        return None

    @property
    def prediction_horizons_s(self) -> dict[str, tuple[float, ...]]:
        """Prediction horizons that its driver may use, by the name of the field."""
        return {}

    @property
    def times_s(self) -> dict[str, float]:
        """Times that must be whole control steps, s, by the name of the field."""
        return {}

    def check(self, key: str, dt_s: float, foresight: Foresight) -> Iterator[Problem]:
        """key: of this driver; foresight: of the planner."""
        horizons_s = {f"{key}.{name}": values for name, values in self.prediction_horizons_s.items()}
        yield from check_horizons(horizons_s, dt_s, foresight)
        yield from check_times({f"{key}.{name}": (time_s,) for name, time_s in self.times_s.items()}, dt_s)

    @property
    def fixed_horizon_s(self) -> float | None:
        """The one horizon of all its decisions, s; None where it has several or none."""
        return None

    @abstractmethod
    def driver(self, game: "Game", episode_key: Tensor) -> Driver:
        """Driver of the ego for a batch of episodes that start together.

        episode_key: [E] int64, key of the random draws in each episode
        """


@schema
class HorizonRule(DriverConfig):
    """Config of a driver that chooses prediction horizons by a rule on what it perceives, and follows the planner."""

    @abstractmethod
    def choose(self, simulator: Simulator) -> ChooseHorizon:
        """The rule."""

    def driver(self, game: "Game", episode_key: Tensor) -> Driver:
        return HorizonDriver(self.choose(game.simulator), game.plan)


@schema
class MotionRule(DriverConfig):
    """Config of a driver that moves by a rule on what it perceives, without the planner."""

    @abstractmethod
    def rule(self, simulator: Simulator) -> Callable[[Perception], Motion]:
        """The rule: perception of S agents -> their motion [E, S] in the next control step."""

    def driver(self, game: "Game", episode_key: Tensor) -> Driver:
        return MotionDriver(self.rule(game.simulator))


class MotionDriver:
    """Driver that moves by a rule."""

    def __init__(self, rule: Callable[[Perception], Motion]) -> None:
        self.drive = rule
