"""The curriculum of Algorithm 1: stages (K_i, D_i), each a number of iterations and a distribution of tasks."""

from typing import Annotated

from pydantic import Field

from negopipe.schema import Label, PositiveInt, schema
from negopipe.simulation.scenario import Families


@schema
class CurriculumStageConfig:
    """One stage.

    name: shown in the progress line and the learning curves
    n_iterations: K_i, iterations of collecting and updating
    families: D_i, the start-distance distribution per style and the weight of each style's tasks
    """

    name: Label
    n_iterations: PositiveInt
    families: Annotated[Families, Field(min_length=1)]


@schema
class CurriculumConfig:
    """The stages in order. The paper samples M tasks and N trajectories of each per iteration; here every world
    draws a new task from D_i when its episode ends, so M is the number of episodes and N is 1."""

    stages: Annotated[tuple[CurriculumStageConfig, ...], Field(min_length=1)]
