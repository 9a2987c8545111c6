"""The curriculum of Algorithm 1: stages (K_i, D_i), each a number of iterations and a distribution of tasks."""

from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated, Any

from pydantic import Field

from negopipe.game.reward import RewardConfig
from negopipe.learning.demonstrations import DemonstrationsConfig
from negopipe.schema import Fraction, Interval, Label, PositiveInt, schema
from negopipe.simulation.scenario import Families, ScenarioConfig
from negopipe.simulation.starts import check_starts


@schema
class CurriculumStageConfig:
    """One stage.

    name: demonstrations in the progress line and the learning curves
    n_iterations: K_i, iterations of collecting and updating
    families: D_i, the start-distance distribution per style and the weight of each style's tasks
    """

    name: Label
    n_iterations: PositiveInt
    families: Annotated[Families, Field(min_length=1)]


@schema
class StartsConfig:
    """How training starts its tasks beside what the families say; the evaluation's starts are the scenario's."""

    ego_start_distance_m: Interval
    start_speed_mps: Interval


@schema
class AdvanceConfig:
    """When a stage ends early.

    success_rate: of the stage's latest `n_episodes` episodes so many were a success
    """

    success_rate: Fraction
    n_episodes: PositiveInt


@schema
class CurriculumConfig:
    """The stages in order. The paper samples M tasks and N trajectories of each per iteration; here every world
    draws a new task from D_i when its episode ends, so M is the number of episodes and N is 1.

    advance: null = every stage takes its K_i iterations; else a stage may end early. The last stage takes all
        iterations that are left, so that a training has sum K_i iterations in any case
    starts: of all stages
    rewards: of stages, by name, that pay otherwise than the run's reward
    demonstrations: null = the policy learns from its own decisions alone
    """

    stages: Annotated[tuple[CurriculumStageConfig, ...], Field(min_length=1)]
    advance: AdvanceConfig | None
    starts: StartsConfig
    rewards: dict[Label, RewardConfig]
    demonstrations: DemonstrationsConfig | None

    def reward(self, stage: CurriculumStageConfig, otherwise: RewardConfig) -> RewardConfig:
        """What a stage pays."""
        return self.rewards.get(stage.name, otherwise)

    def scenario(self, evaluated: ScenarioConfig) -> ScenarioConfig:
        """The scenario in which training drives, for the one in which the policy is evaluated."""
        return replace(
            evaluated,
            ego_start_distance_m=self.starts.ego_start_distance_m,
            start_speed_mps=self.starts.start_speed_mps,
        )

    def check_starts(self, evaluated: ScenarioConfig) -> None:
        """UserError where a task that is trained on is lost before it begins."""
        stages = enumerate(self.stages)
        families = {f"curriculum.stages.{i}.families.{name}": f for i, s in stages for name, f in s.families.items()}
        check_starts(self.scenario(evaluated), families, "curriculum.starts.ego_start_distance_m")


class Curriculum:
    """Where a training stands.

    index: of the stage in `config.stages`
    """

    def __init__(self, config: CurriculumConfig) -> None:
        self.config = config
        self.index, self._n_in_stage = 0, 0
        self._successes: deque[bool] = deque(maxlen=config.advance.n_episodes if config.advance else 1)

    @property
    def stage(self) -> CurriculumStageConfig:
        return self.config.stages[self.index]

    @property
    def n_total(self) -> int:
        """Iterations of all stages together."""
        return sum(stage.n_iterations for stage in self.config.stages)

    def count(self, successes: Iterable[bool]) -> bool:
        """An iteration is done; whether the next one belongs to another stage.

        successes: of the episodes that ended in it
        """
        self._n_in_stage += 1
        self._successes.extend(successes)
        is_last = self.index == len(self.config.stages) - 1
        if is_last or not (self._n_in_stage >= self.stage.n_iterations or self._is_mastered()):
            return False
        self.index, self._n_in_stage = self.index + 1, 0
        self._successes.clear()
        return True

    def _is_mastered(self) -> bool:
        advance, n = self.config.advance, len(self._successes)
        return advance is not None and n == advance.n_episodes and sum(self._successes) >= advance.success_rate * n

    def state_dict(self) -> dict[str, Any]:
        """All of it, as JSON can say it."""
        return {"index": self.index, "n_in_stage": self._n_in_stage, "successes": list(self._successes)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken."""
        self.index, self._n_in_stage = state["index"], state["n_in_stage"]
        self._successes.clear()
        self._successes.extend(state["successes"])
