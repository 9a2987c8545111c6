"""Demonstrations: how long they count, that they leave the value alone, and that every algorithm follows them."""

from dataclasses import replace

import pytest
import torch
from corridor import CPU, TWO_FIRST, Corridor, config_of, network
from torch import Generator, Tensor

from negopipe.learning.demonstrations import Demonstrations, DemonstrationsConfig
from negopipe.learning.learner import Learner
from negopipe.learning.rollout import RunningEpisodes, collect

CONFIG = DemonstrationsConfig(n_tasks=1, population=1, rounds=1, n_decisions=64, weight=2.0, until=0.5)
DOWNHILL = Demonstrations(CONFIG, torch.eye(7), torch.zeros(7, dtype=torch.int64))
"""In every cell of the corridor the action that leads to the bad end, which nobody would find out by himself."""


def up(algorithm: str, shown: Demonstrations | None, progress: float = 0.0, n_iterations: int = 12) -> Tensor:
    """[7] probability of going up in each cell, of a policy that has been trained a little."""
    config = config_of(algorithm, "algorithm.n_steps=16")
    policy, actions = network(), Generator().manual_seed(1)
    learner = Learner(policy, config, Generator().manual_seed(2), shown)
    env, running = Corridor(config.n_worlds), RunningEpisodes.start(config.n_worlds, CPU)
    for _ in range(n_iterations):
        rollout, running = collect(env, policy, config.n_steps, actions, running)
        learner.update(rollout, progress)
    return policy(torch.eye(7))[0].softmax(-1)[:, 1].detach()


def test_the_weight_shrinks_to_nothing() -> None:
    assert [CONFIG.weight_at(progress) for progress in (0.0, 0.25, 0.5, 0.9)] == [2.0, 1.0, 0.0, 0.0]


def test_what_is_shown_is_drawn_anew_and_says_nothing_of_the_value() -> None:
    policy, random = network(), Generator().manual_seed(0)
    first, second = (DOWNHILL.show(policy, 0.25, random) for _ in range(2))
    assert first is not None
    assert second is not None
    assert not torch.equal(first.observation, second.observation)
    assert first.observation.shape == (64, 7)
    assert torch.equal(first.advantage, torch.ones(64))
    logits, value = policy(first.observation)
    assert torch.equal(first.returns, value)
    assert torch.equal(first.log_prob, logits.log_softmax(-1)[:, 0])
    assert DOWNHILL.show(policy, 0.5, random) is None


@pytest.mark.parametrize("algorithm", TWO_FIRST)
def test_every_algorithm_follows_what_is_shown_while_it_counts(algorithm: str) -> None:
    assert (up(algorithm, DOWNHILL) < up(algorithm, None)).all()
    assert torch.equal(up(algorithm, DOWNHILL, progress=0.5), up(algorithm, None, progress=0.5))


@pytest.mark.parametrize("change", [{"weight": 0.5}, {"until": 1.0}, {"n_decisions": 8}], ids=str)
def test_options_act(change: dict[str, float]) -> None:
    other = replace(DOWNHILL, config=replace(CONFIG, **change))
    assert not torch.equal(up("a2c", other, 0.1), up("a2c", DOWNHILL, 0.1))
