"""How the ego may choose its horizon: by the trained policy, or by a sequence that was found beforehand."""

from itertools import count

import torch
from torch import Tensor

from negopipe.agents.driver import ChooseHorizon, HorizonDriver, MakeDriver
from negopipe.game.game import Game
from negopipe.policy.actor_critic import ActorCritic, greedy_action
from negopipe.simulation.perception import Perception
from negopipe.tensors.chunked import ChunkedFunction
from negopipe.tensors.stateless_rng import mix, uniform

ACTIONS = 0x5A17
"""Sets what actions are drawn from apart from what else is drawn for an episode."""
BATCH = 64
"""Grids that the network is shown at once, always so many: with another number its last bits may be others."""


def by_horizon(game: Game, choose_horizon: ChooseHorizon) -> MakeDriver:
    """The game's planner with the horizons of `choose_horizon`, the same driver for all episodes."""
    return lambda episode_key: HorizonDriver(choose_horizon, game.plan)


def adaptive_planner(
    policy: ActorCritic, game: Game, horizons_s: tuple[float, ...], episode_key: Tensor | None = None
) -> ChooseHorizon:
    """The policy: looks at the grids and picks the most probable horizon.

    episode_key: [E] int64, from which the horizon is drawn instead; the planner counts the decisions, so make one for
        each batch of episodes that start together, and drive them in lockstep
    """
    horizons = torch.tensor(horizons_s, device=game.planner.times.device)
    look = ChunkedFunction(lambda grids: policy(grids)[0], BATCH, lambda fn: fn)
    decisions = count()

    @torch.no_grad()
    def choose(perception: Perception) -> Tensor:
        logits = look(game.draw(perception))
        action = greedy_action(logits) if episode_key is None else _drawn(logits, episode_key, next(decisions))
        return horizons[action][:, None]

    return choose


def _drawn(logits: Tensor, episode_key: Tensor, decision: int) -> Tensor:
    """[E] int64, by inversion of the cumulative probabilities."""
    threshold = uniform(mix(mix(episode_key) + ACTIONS), decision)
    until = logits.float().softmax(-1).cumsum(-1)
    return (threshold[:, None] > until).sum(-1).clamp(max=logits.shape[-1] - 1)


def sequence_planner(horizon_s: Tensor) -> ChooseHorizon:
    """Plays `horizon_s` [T, E] (s), its next row at every decision.

    It counts the decisions, as no vehicle perceives the time: make one for each batch of episodes that start
    together, and drive all E tasks in one batch (`n_worlds` = E), in step.
    """
    rows = iter(horizon_s[:, :, None])

    def choose(perception: Perception) -> Tensor:
        return next(rows)

    return choose
