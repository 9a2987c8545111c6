"""Held-out tasks of the evaluation: the same for every planner and training seed."""

from typing import TYPE_CHECKING

from negopipe.game.game import Game
from negopipe.simulation.scenario import TaskSampler, pair_styles
from negopipe.simulation.state import Task
from negopipe.tensors.seeding import generator

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig


def held_out_tasks(config: "RunConfig", game: Game, setting: str, n_episodes: int | None = None) -> Task:
    """The setting's tasks, the same for every planner and training seed; training draws from other streams.

    n_episodes: their number; None = `evaluation.n_episodes`
    """
    stream = generator(config.evaluation.task_seed, f"held-out tasks {setting}", game.planner.times.device)
    families = pair_styles(config.scenario.families, config.scenario.pairing)
    return TaskSampler(config.scenario, {setting: families[setting]}, stream, game.cast.assign).draw(
        n_episodes or config.evaluation.n_episodes
    )
