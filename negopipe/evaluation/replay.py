"""Replay of evaluated episodes from their tasks and horizons, with a record of the policy's inputs and outputs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from negopipe.agents.driver import ChooseHorizon
from negopipe.agents.horizon_drivers import by_horizon, sequence_planner
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.trace import Trace
from negopipe.game.game import Game
from negopipe.game.reward import RewardConfig
from negopipe.policy.actor_critic import ActorCritic
from negopipe.simulation.perception import Perception
from negopipe.simulation.state import Task

N_GRID_AXES = 3
"""Axes of an observation that is grids: frames, rows, columns."""


@dataclass(frozen=True)
class PolicyTrace:
    """Inputs and outputs of the policy in one episode of T decisions.

    grids: [T, F, H, W] uint8, occupancy grids as `OccupancyGrid.draw` makes them; None where the policy sees no grids
    probability: [T, A] float32, probability of each horizon
    horizons_s: [A], s
    frame_interval_s: time between frames, s
    """

    grids: np.ndarray | None
    probability: np.ndarray
    horizons_s: tuple[float, ...]
    frame_interval_s: float


Watch = Callable[[Perception], None]
"""Called with the ego's perception before every decision."""


def replay(
    game: Game,
    tasks: Task,
    horizon_s: Sequence[np.ndarray],
    reward_config: RewardConfig,
    names: tuple[str, str],
    watch: Watch | None = None,
) -> Trace:
    """The record of E episodes in which the ego uses the given horizons.

    horizon_s: horizons [T] of each episode, s
    names: (planner, setting) of the record
    """
    choose = sequence_planner(_together(horizon_s, game.simulator.scenario.episode_steps).to(tasks.family.device))
    ego = by_horizon(game, choose if watch is None else _watched(choose, watch))
    return drive_episodes(game, ego, tasks, len(tasks), reward_config, names, is_lockstep=True)


def record_policy(
    game: Game,
    policy: ActorCritic,
    horizons_s: tuple[float, ...],
    frame_interval_s: float,
    tasks: Task,
    horizon_s: Sequence[np.ndarray],
    reward_config: RewardConfig,
) -> list[PolicyTrace]:
    """Inputs and outputs of the policy in E episodes with the known choices `horizon_s` (see `replay`)."""
    seen: list[np.ndarray] = []
    probability: list[np.ndarray] = []

    @torch.no_grad()
    def watch(perception: Perception) -> None:
        drawn = game.draw(perception)
        seen.append(drawn.cpu().numpy())
        probability.append(policy(drawn)[0].softmax(-1).float().cpu().numpy())

    replay(game, tasks, horizon_s, reward_config, ("watched", "replay"), watch)
    has_grids = len(game.observation_shape) == N_GRID_AXES
    return [
        PolicyTrace(
            np.stack([drawn[episode] for drawn in seen[: len(own)]]) if has_grids else None,
            np.stack([each[episode] for each in probability[: len(own)]]),
            horizons_s,
            frame_interval_s,
        )
        for episode, own in enumerate(horizon_s)
    ]


def _together(horizon_s: Sequence[np.ndarray], n_steps: int) -> Tensor:
    """[T, E] float32; decisions after the end of an episode have no effect."""
    rows = np.zeros((n_steps, len(horizon_s)), dtype=np.float32)
    for episode, own in enumerate(horizon_s):
        rows[: len(own), episode] = own
    return torch.from_numpy(rows)


def _watched(choose: ChooseHorizon, watch: Watch) -> ChooseHorizon:
    def choose_watched(perception: Perception) -> Tensor:
        watch(perception)
        return choose(perception)

    return choose_watched
