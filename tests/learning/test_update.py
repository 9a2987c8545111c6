"""What all algorithms share, and PPO's objective, by hand."""

import math

import pytest
import torch
from corridor import config_of, network
from torch import Generator, Tensor

from negopipe.learning.ppo import clipped_loss
from negopipe.learning.update import Decisions, Outputs, forward, measure_kl, minibatches, total_loss

HALF = math.log(0.5)


def decisions(advantage: list[float], log_prob: float = HALF) -> Decisions:
    n = len(advantage)
    return Decisions(
        observation=torch.zeros(n, 1),
        action=torch.zeros(n, dtype=torch.int64),
        log_prob=torch.full((n,), log_prob),
        advantage=torch.tensor(advantage),
        returns=torch.ones(n),
    )


def outputs(probability: float, n: int = 1) -> Outputs:
    """Action 0 has this probability."""
    log_probs = torch.tensor([[probability, 1 - probability]]).log().expand(n, 2).clone().requires_grad_()
    return Outputs(log_probs, torch.zeros(n))


@pytest.mark.parametrize(
    ("probability", "advantage", "loss", "has_gradient"),
    [
        (0.5, 2.0, -2.0, True),  # ratio 1
        (0.55, 2.0, -2.2, True),  # within the clip
        (0.7, 2.0, -2.4, False),  # 1.4 is paid as 1.2
        (0.3, 2.0, -1.2, True),  # too little of a good action is not clipped
        (0.3, -2.0, 1.6, False),  # 0.6 is charged as 0.8
        (0.7, -2.0, 2.8, True),  # too much of a bad one is not
    ],
)
def test_clipped_loss(probability: float, advantage: float, loss: float, has_gradient: bool) -> None:
    out = outputs(probability)
    value = clipped_loss(out, decisions([advantage]), clip=0.2)
    assert value.item() == pytest.approx(loss, rel=1e-5)
    (gradient,) = torch.autograd.grad(value, out.log_probs)
    assert bool(gradient.abs().sum() > 0) == has_gradient


def test_total_loss() -> None:
    policy, config = network(), config_of("a2c", "algorithm.value_coefficient=0.5", "algorithm.entropy_coefficient=0.1")
    policy.value_std.fill_(2.0)
    loss, parts = total_loss(torch.tensor(3.0), outputs(0.5, 4), decisions([0.0] * 4), policy, config, progress=0.0)
    assert parts["value_loss"].item() == pytest.approx(0.5 * (1 / 2) ** 2)
    assert parts["entropy"].item() == pytest.approx(math.log(2))
    assert loss.item() == pytest.approx(3.0 + 0.5 * 0.125 - 0.1 * math.log(2))


def test_shares_fall_linearly() -> None:
    config = config_of(
        "a2c", "algorithm.final_step_share=0.2", "algorithm.final_entropy_share=0", "algorithm.entropy_coefficient=0.1"
    )
    assert [config.step_share(p) for p in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 0.6, 0.2])
    assert [config.entropy_weight(p) for p in (0.0, 0.5, 1.0)] == pytest.approx([0.1, 0.05, 0.0])


def test_an_entropy_penalty_turns_the_weight_of_the_entropy_around() -> None:
    config = config_of(
        "a2c", "algorithm.entropy_coefficient=0.1", "algorithm.entropy_penalty={start: 0.5, coefficient: 0.2}"
    )
    assert config.entropy_weight(0.49) > 0
    assert [config.entropy_weight(p) for p in (0.5, 1.0)] == [-0.2, -0.2]


def test_measured_kl() -> None:
    policy, probe = network(), torch.eye(7)
    before = forward(policy, probe).first(7)
    assert all(value == 0 for value in measure_kl(policy, probe, before).values())
    head = policy.policy_head[-1]
    with torch.no_grad():
        head.bias.copy_(torch.tensor([0.0, 1.0]))
        head.weight.zero_()
        policy.value_head[-1].bias.add_(0.3)
    even = Outputs(torch.full((7, 2), HALF), before.value)
    new = torch.tensor([0.0, 1.0]).log_softmax(-1)
    moved = measure_kl(policy, probe, even)
    assert moved["kl"].item() == pytest.approx(float((0.5 * (HALF - new)).sum()), rel=1e-5)
    assert moved["value_kl"].item() == pytest.approx(0.5 * 0.3**2, rel=1e-4)


def test_minibatches_partition_the_decisions() -> None:
    parts: list[Tensor] = list(minibatches(100, 48, Generator().manual_seed(0)))
    assert [len(part) for part in parts] == [34, 34, 32]
    assert torch.cat(parts).sort().values.tolist() == list(range(100))
