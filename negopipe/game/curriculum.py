"""The curriculum of Algorithm 1: stages (K_i, D_i), each a number of iterations and a distribution of tasks."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Annotated, Any

from pydantic import Field, model_validator

from negopipe.checks import Foresight, Memory, Observed, Problem, check_horizons
from negopipe.game.reward import RewardConfig
from negopipe.learning.demonstrations import DemonstrationsConfig
from negopipe.learning.teacher import TeacherConfig
from negopipe.schema import Fraction, Interval, Label, PositiveInt, schema
from negopipe.simulation.scenario import Families, FamilyConfig, ScenarioConfig
from negopipe.simulation.starts import check_starts


@schema
class CurriculumStageConfig:
    """One stage.

    name: label in the progress line and the learning curves
    n_iterations: K_i, iterations of collecting and updating
    families: D_i, the distributions of start distances and styles, and their weights
    """

    name: Label
    n_iterations: PositiveInt
    families: Annotated[Families, Field(min_length=1)]


@schema
class StartsConfig:
    """Starts of the training tasks that the families leave open; those of the evaluation are the scenario's."""

    ego_start_distance_m: Interval
    start_speed_mps: Interval


@schema
class AdvanceConfig:
    """Condition for the early end of a stage.

    success_rate: least share of successes among the stage's latest `n_episodes` episodes
    """

    success_rate: Fraction
    n_episodes: PositiveInt


@schema
class CurriculumConfig:
    """The stages in order.

    The paper samples M tasks and N trajectories of each per iteration. Here every world draws a new task from D_i when
    its episode ends, so M is the number of episodes and N is 1.

    advance: null = every stage takes its K_i iterations; otherwise a stage may end early. The last stage takes all
        iterations that are left, so a training has sum K_i iterations in any case
    starts: starts of the tasks in all stages
    rewards: by the name of the stage, rewards that differ from the run's
    demonstrations: decisions of a search to learn from as well; null = none
    teacher: policy to imitate at first; null = none
    hard_share: share of the draws of drivers and streets that follows what the policy loses most (Jiang et al. 2021,
        "Prioritized level replay", with the share of lost episodes as the score); 0 = the population's weights alone
    """

    stages: Annotated[tuple[CurriculumStageConfig, ...], Field(min_length=1)]
    advance: AdvanceConfig | None
    starts: StartsConfig
    rewards: dict[Label, RewardConfig]
    demonstrations: DemonstrationsConfig | None
    teacher: TeacherConfig | None
    hard_share: Fraction

    def reward(self, stage: CurriculumStageConfig, otherwise: RewardConfig) -> RewardConfig:
        """Reward of a stage; `otherwise` where the stage has none of its own."""
        return self.rewards.get(stage.name, otherwise)

    def scenario(self, evaluated: ScenarioConfig) -> ScenarioConfig:
        """The scenario of the training, from the one of the evaluation."""
        return replace(
            evaluated,
            ego_start_distance_m=self.starts.ego_start_distance_m,
            start_speed_mps=self.starts.start_speed_mps,
        )

    @property
    def _families(self) -> dict[str, FamilyConfig]:
        """All families of all stages, by key."""
        stages = enumerate(self.stages)
        return {f"curriculum.stages.{i}.families.{name}": f for i, s in stages for name, f in s.families.items()}

    @model_validator(mode="after")
    def _has_one_example(self) -> "CurriculumConfig":
        if self.demonstrations is not None and self.teacher is not None:
            raise ValueError("must have demonstrations or a teacher, not both: one of the two must be null")
        return self

    def check(self, dt_s: float, foresight: Foresight) -> Iterator[Problem]:
        """foresight: of the planner."""
        for key, family in self._families.items():
            yield from check_horizons(family.horizons_s(key), dt_s, foresight)

    def check_training(self, evaluated: ScenarioConfig, paid: RewardConfig) -> Iterator[Problem]:
        """What a training asks for: tasks that are not lost before they begin, a reward that a search can climb."""
        yield from check_starts(self.scenario(evaluated), self._families, "curriculum.starts.ego_start_distance_m")
        if self.demonstrations is not None:
            yield from paid.check_searchable("reward", "curriculum.demonstrations")

    def memory(self, episode_steps: int, observed: Observed) -> Iterator[Memory]:
        """Memory of the demonstrations, with those that one iteration shows."""
        if self.demonstrations is not None:
            n_tasks = self.demonstrations.n_tasks * len(self.stages[-1].families)
            n_shown = n_tasks * episode_steps + self.demonstrations.n_decisions
            keys = "curriculum.demonstrations.n_tasks curriculum.demonstrations.n_decisions scenario.episode_steps"
            yield Memory("the demonstrations", 2 * n_shown * observed.n_bytes, (*keys.split(), *observed.keys))


class Curriculum:
    """Progress of a training through the stages.

    index: position of the current stage in `config.stages`
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

    def finish_iteration(self, successes: Iterable[bool]) -> bool:
        """Count an iteration; returns whether it was the last of its stage (of the final stage it never is).

        successes: outcomes of the episodes that ended in the iteration
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
        """The whole state, as JSON values."""
        return {"index": self.index, "n_in_stage": self._n_in_stage, "successes": list(self._successes)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.index, self._n_in_stage = state["index"], state["n_in_stage"]
        self._successes.clear()
        self._successes.extend(state["successes"])
