"""Learning from a teacher: every algorithm imitates it, the value stays the policy's own."""

import pytest
import torch
from corridor import ALGORITHMS, CPU, Corridor, config_of, network
from torch import Generator, Tensor

from negopipe.learning.learner import Learner
from negopipe.learning.rollout import RunningEpisodes, collect

AGENTS = 8


def down() -> Tensor:
    """In every cell of the corridor mostly the action to the bad end, which nobody would find out by himself."""
    return torch.tensor([[0.9, 0.1]]).expand(AGENTS, 2)


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
    for name in ("observation", "action", "log_prob", "reward", "value", "is_success"):
        assert torch.equal(getattr(own, name), getattr(taught, name)), name
    assert own.advice is None
    assert torch.equal(taught.advice, down().expand(20, AGENTS, 2))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_student_comes_to_the_probabilities_of_the_teacher(algorithm: str) -> None:
    taught, free = up(algorithm, is_taught=True), up(algorithm, is_taught=False)
    assert ((taught - 0.1).abs() < (free - 0.1).abs()).all()
