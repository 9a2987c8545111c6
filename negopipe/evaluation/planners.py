"""How the ego may choose its horizon: by the trained policy, or by a sequence that was found beforehand."""

import torch
from torch import Generator, Tensor

from negopipe.chunks import InChunks
from negopipe.driver import ChooseHorizon, HorizonDriver, MakeDriver
from negopipe.env import Game
from negopipe.policy.actor_critic import ActorCritic, greedy_action, sample_action
from negopipe.simulation.perception import Perception

BATCH = 64
"""Grids that the network is shown at once, always so many: with another number its last bits may be others."""


def fixed_name(horizon_s: float) -> str:
    """Name of a fixed horizon in tables and files, e.g. `fixed_2`."""
    return f"fixed_{horizon_s:g}"


def by_horizon(game: Game, choose_horizon: ChooseHorizon) -> MakeDriver:
    """The game's planner with the horizons of `choose_horizon`, the same driver for all episodes."""
    return lambda chance: HorizonDriver(choose_horizon, game.plan)


def adaptive_planner(
    policy: ActorCritic, game: Game, horizons_s: tuple[float, ...], sampling: Generator | None
) -> ChooseHorizon:
    """The policy: looks at the grids and picks a horizon; the most probable one, or drawn with `sampling`."""
    horizons = torch.tensor(horizons_s, device=game.planner.times.device)
    look = InChunks(lambda grids: policy(grids)[0], BATCH, lambda fn: fn)

    @torch.no_grad()
    def choose(perception: Perception) -> Tensor:
        logits = look(game.draw(perception))
        action = greedy_action(logits) if sampling is None else sample_action(logits, sampling)
        return horizons[action][:, None]

    return choose


def sequence_planner(horizon_s: Tensor) -> ChooseHorizon:
    """Plays `horizon_s` [T, E] (s), its next row at every decision.

    It counts the decisions, as no vehicle perceives the time: make one for each batch of episodes that start
    together, and drive all E tasks in one batch (`n_worlds` = E), in step.
    """
    rows = iter(horizon_s[:, :, None])

    def choose(perception: Perception) -> Tensor:
        return next(rows)

    return choose
