"""Learning from a teacher: every algorithm imitates it, the value stays the policy's own."""

import pytest
import torch
from corridor import ALGORITHMS, CPU, Corridor, config_of, network
from torch import Generator, Tensor

from negopipe.learning.learner import Learner
from negopipe.learning.rollout import RunningEpisodes, collect

AGENTS = 8


def down() -> Tensor:
    """In every cell of the corridor the action that leads to the bad end, which nobody would find out by himself."""
    return torch.zeros(AGENTS, dtype=torch.int64)


def up(algorithm: str, is_taught: bool) -> Tensor:
    """[7] probability of going up in each cell, of a policy that has been trained a little."""
    config = config_of(algorithm, "algorithm.n_steps=16", f"algorithm.n_worlds={AGENTS}")
    policy, actions = network(), Generator().manual_seed(1)
    learner = Learner(policy, config, Generator().manual_seed(2))
    env, running = Corridor(AGENTS), RunningEpisodes.start(AGENTS, CPU)
    for _ in range(12):
        rollout, running = collect(env, policy, 16, actions, running, down if is_taught else None)
        learner.update(rollout, 0.0)
    return policy(torch.eye(7))[0].softmax(-1)[:, 1].detach()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_imitates_the_teacher(algorithm: str) -> None:
    assert (up(algorithm, is_taught=True) < up(algorithm, is_taught=False)).all()


def test_the_policy_drives_and_the_teacher_labels() -> None:
    policy = network()
    rollouts = []
    for teacher in (None, down):
        running = RunningEpisodes.start(AGENTS, CPU)
        rollouts.append(collect(Corridor(AGENTS), policy, 20, Generator().manual_seed(0), running, teacher)[0])
    own, taught = rollouts
    assert (own.is_taught, taught.is_taught) == (False, True)
    for name in ("observation", "reward", "value", "is_success"):
        assert torch.equal(getattr(own, name), getattr(taught, name)), name
    assert own.action.any()
    assert not taught.action.any()
    logits = policy(taught.observation.flatten(0, 1))[0]
    assert torch.equal(taught.log_prob.flatten(), logits.log_softmax(-1)[:, 0])
