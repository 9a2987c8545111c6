"""Worlds of held-out episodes, driven by a policy: the states in which an export is compared with torch.

States at the start of an episode would not do: the past is then one state repeated.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from negopipe.evaluation.held_out import held_out_tasks
from negopipe.game.game import Game
from negopipe.simulation.state import World
from negopipe.tensors.tree import map_tensors

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

FEWEST_DECISIONS = 20
"""Decisions that an episode has at least; shorter ones leave out of the tasks drawn what was asked for."""


@torch.no_grad()
def drive_held_out(config: "RunConfig", game: Game, choose: Callable[[World], Tensor], n_decisions: int) -> None:
    """Drive held-out episodes until `n_decisions` are made, an equal share in each setting of the evaluation.

    choose: World, those whose episode runs -> horizon of the ego [E] (s)
    """
    settings, n_worlds = config.evaluation.settings, config.export.n_worlds
    for index, setting in enumerate(settings):
        n_left = n_decisions * (index + 1) // len(settings) - n_decisions * index // len(settings)
        n_tasks = n_left // FEWEST_DECISIONS + n_worlds
        drawn = replace(config, evaluation=replace(config.evaluation, n_episodes=n_tasks))
        tasks = held_out_tasks(drawn, game, setting)
        for first in range(0, n_tasks, n_worlds):
            batch = map_tensors(lambda field, i=first: field[i : i + n_worlds], tasks)
            n_left -= _drive(game, game.simulator.reset(batch), choose, n_left)


def _drive(game: Game, world: World, choose: Callable[[World], Tensor], n_most: int) -> int:
    """Drive until all episodes are over or `n_most` decisions are made; returns the number of decisions."""
    n_made = 0
    while n_made < n_most and len(world.step) > 0:
        world = map_tensors(lambda field, n=n_most - n_made: field[:n], world)
        n_made += len(world.step)
        world, events, *_ = game.drive(world, game.choose(world, choose(world)))
        is_running = (~(events.is_terminated | events.is_truncated)).nonzero()[:, 0]
        world = map_tensors(lambda field, at=is_running: field.index_select(0, at), world)
    return n_made
