"""Policies on the other side: social vehicles whose prediction horizons a network chooses."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from negopipe.agents.horizon_drivers import drawn_action, in_batches
from negopipe.policy.actor_critic import ActorCritic, greedy_action
from negopipe.simulation.state import World
from negopipe.tensors.stateless_rng import mix
from negopipe.tensors.tree import map_tensors

if TYPE_CHECKING:
    from negopipe.game.game import Game


class Learned(NamedTuple):
    """A policy that drives social vehicles.

    policy: network for the observations of the game
    horizons_s: its choices, s
    is_sampled: horizons are drawn by their probabilities, else the most probable one is taken
    """

    policy: ActorCritic
    horizons_s: tuple[float, ...]
    is_sampled: bool


def with_policies(game: "Game", learned: Mapping[int, Learned]) -> "Game":
    """The game with policies for the drivers of these indices in its population.

    A network sees what the vehicle perceives, as the ego's does. It may change while the game is used, as in training.
    """
    if not learned:
        return game
    device = game.planner.times.device
    tables = {index: torch.tensor(each.horizons_s, device=device) for index, each in learned.items()}
    logits_of = {index: in_batches(each.policy, device) for index, each in learned.items()}

    @torch.no_grad()
    def choose(world: World, ego: Tensor) -> Tensor:
        horizons = world.horizons(ego)
        for index, each in learned.items():
            row, agent = (world.task.casting.driver == index).nonzero().unbind(1)
            if len(row) == 0:
                continue
            part = map_tensors(lambda field, row=row: field.index_select(0, row), world)
            logits = logits_of[index](game.see_as(part, agent))
            key = mix(mix(part.task.noise_seed) + agent)
            action = drawn_action(logits, key, part.step) if each.is_sampled else greedy_action(logits)
            horizons[row, agent] = tables[index][action]
        return horizons

    return replace(game, choose=choose)
