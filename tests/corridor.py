"""A corridor of seven cells that every algorithm should learn to walk, and training on it."""

from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from pydantic import TypeAdapter
from rollouts import episode_statistics
from torch import Generator, Tensor, nn

from negopipe.learning.learner import AlgorithmConfig, AnyAlgorithmConfig, Learner
from negopipe.learning.rollout import Rollout, RunningEpisodes, Transition, collect
from negopipe.policy.actor_critic import ActorCritic, mlp

CPU = torch.device("cpu")
CONF = Path(__file__).parents[1] / "conf"
ALGORITHMS = ("acktr", "acktr_adam", "a2c", "ppo")
TWO_FIRST = ("acktr", "ppo", *(pytest.param(name, marks=pytest.mark.slow) for name in ("acktr_adam", "a2c")))
"""For what takes a training: the fast tests try two algorithms."""
SMALL = (
    "algorithm.n_worlds=16", "algorithm.n_steps=8", "algorithm.minibatch_size=64", "algorithm.n_probe=32",
)  # fmt: skip
SMALL_KFAC = (
    "algorithm.kfac.n_statistics=32", "algorithm.kfac.statistics_interval=2", "algorithm.kfac.inverse_interval=2",
)  # fmt: skip


class Corridor:
    """Cells 0 to 6, start at 3: action 1 moves up, 0 down. Cell 6 gives +10, cell 0 -10, each step costs 0.25.

    Cut off after 12 steps. The best return is 10 - 3 * 0.25 = 9.25.
    """

    def __init__(self, n_worlds: int) -> None:
        self.n_worlds = n_worlds
        self.cell = torch.full((n_worlds,), 3)
        self.steps = torch.zeros(n_worlds, dtype=torch.int64)

    def observe(self) -> Tensor:
        return nn.functional.one_hot(self.cell, 7).float()

    def is_learning(self) -> Tensor:
        return torch.ones(self.n_worlds, dtype=torch.bool)

    def step(self, action: Tensor) -> Transition:
        cell, self.steps = self.cell + 2 * action - 1, self.steps + 1
        is_success, is_collision = cell == 6, cell == 0
        is_terminated = is_success | is_collision
        is_truncated = (self.steps == 12) & ~is_terminated
        is_done = is_terminated | is_truncated
        self.cell = torch.where(is_done, 3, cell)
        self.steps = torch.where(is_done, 0, self.steps)
        reward = torch.where(is_success, 10.0, 0.0) + torch.where(is_collision, -10.0, 0.0) - 0.25
        final = nn.functional.one_hot(cell[is_done], 7).float()
        return Transition(self.observe(), final, reward, is_terminated, is_truncated, is_success, is_collision)


@cache
def config_of(algorithm: str, *overrides: str) -> Any:
    """conf/algorithm/<algorithm>.yaml, small, with `overrides` as on the command line: groups first, then values."""
    groups = tuple(text for text in overrides if "/" in text.partition("=")[0])
    values = [text for text in overrides if text not in groups]
    small = (*SMALL, *SMALL_KFAC) if algorithm.startswith("acktr") else SMALL
    changed = OmegaConf.merge(composed(algorithm, *groups), OmegaConf.from_dotlist([*small, *values]))
    config = OmegaConf.to_container(OmegaConf.create(changed).algorithm, resolve=True)
    return TypeAdapter(AlgorithmConfig).validate_python(config)


@cache
def composed(algorithm: str, *groups: str) -> DictConfig:
    """Hydra takes most of the time of a small training."""
    with initialize_config_dir(str(CONF), version_base=None):
        return compose("config", [f"algorithm={algorithm}", *groups])


def network(seed: int = 0) -> ActorCritic:
    encoder = nn.Sequential(mlp((7, 16)), nn.ReLU())
    return ActorCritic(encoder, 16, (16,), 2, torch.float32, Generator().manual_seed(seed))


def train(
    config: AnyAlgorithmConfig, n_iterations: int, progress: float = 0.0
) -> tuple[ActorCritic, Learner, list[dict[str, float]]]:
    policy, actions = network(), Generator().manual_seed(1)
    learner = Learner(policy, config, Generator().manual_seed(2))
    env, running, metrics = Corridor(config.n_worlds), RunningEpisodes.start(config.n_worlds, CPU), []
    for _ in range(n_iterations):
        rollout, running = collect(env, policy, config.n_steps, actions, running)
        metrics.append(learner.update(rollout, progress) | episode_statistics(rollout))
    return policy, learner, metrics


def weights(policy: ActorCritic) -> Tensor:
    return torch.cat([p.detach().flatten() for p in policy.parameters()])


def a_rollout() -> Rollout:
    return collect(Corridor(16), network(), 8, Generator().manual_seed(1), RunningEpisodes.start(16, CPU))[0]
