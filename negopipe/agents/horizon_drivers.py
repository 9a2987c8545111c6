"""Horizon choices of the ego: by the trained policy, or from a sequence that was found beforehand."""

from collections.abc import Callable
from itertools import count
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from negopipe.agents.driver import ChooseHorizon, HorizonDriver, MakeDriver
from negopipe.policy.actor_critic import ActorCritic, action_of_draw, greedy_action
from negopipe.simulation.perception import Perception
from negopipe.tensors.chunked import ChunkedFunction
from negopipe.tensors.stateless_rng import mix, uniform

if TYPE_CHECKING:
    from negopipe.game.game import Game

ACTIONS = 0x5A17
"""Offset of the key from which actions are drawn, apart from the other draws of an episode."""
BATCHES = {"cpu": 64, "cuda": 4096}
"""Observations per call of the network; constant, since the last bits of its output may depend on the number."""


def by_horizon(game: "Game", choose_horizon: ChooseHorizon) -> MakeDriver:
    """Driver with the horizons of `choose_horizon`, the same for all episodes."""
    return lambda episode_key: HorizonDriver(choose_horizon, game.plan)


def adaptive_planner(
    policy: ActorCritic, game: "Game", horizons_s: tuple[float, ...], episode_key: Tensor | None = None
) -> ChooseHorizon:
    """The trained policy: the most probable horizon for what the vehicle observes.

    episode_key: [E] int64, key from which horizons are drawn by their probabilities instead. The choice counts its
        decisions: it is made anew for each batch of episodes that start together, and they are driven in lockstep
    """
    horizons = torch.tensor(horizons_s, device=game.planner.times.device)
    logits_of = in_batches(policy, horizons.device)
    decisions = count()

    @torch.no_grad()
    def choose(perception: Perception) -> Tensor:
        logits = logits_of(game.draw(perception))
        action = greedy_action(logits) if episode_key is None else drawn_action(logits, episode_key, next(decisions))
        return horizons[action][:, None]

    return choose


def in_batches(policy: ActorCritic, device: torch.device) -> Callable[[Tensor], Tensor]:
    """Observations [E, *obs] -> logits [E, n_actions] of the policy, which may change between calls."""
    return ChunkedFunction(lambda observation: policy(observation)[0], [BATCHES[device.type]], lambda fn: fn)


def drawn_action(logits: Tensor, episode_key: Tensor, decision: Tensor | int) -> Tensor:
    """[E] int64: actions drawn by the probabilities.

    decision: number of the decision in the episode, one for all or [E] int64
    """
    return action_of_draw(logits, draw_of(episode_key, decision))


def draw_of(episode_key: Tensor, decision: Tensor | int) -> Tensor:
    """[E] uniform numbers in (0, 1), by which the actions of a decision are drawn; `decision` as in `drawn_action`."""
    return uniform(mix(mix(episode_key) + ACTIONS), decision)


def sequence_planner(horizon_s: Tensor) -> ChooseHorizon:
    """The rows of `horizon_s` [T, E] (s), one per decision.

    The choice counts its decisions, since no vehicle perceives the time. It is made anew for each batch of episodes
    that start together, and all E tasks are driven in lockstep in one batch (`n_worlds` = E).
    """
    rows = iter(horizon_s[:, :, None])

    def choose(perception: Perception) -> Tensor:
        return next(rows)

    return choose
