"""ACKTR: the trust regions hold, and what cannot be computed moves nothing."""

import pytest
import torch
from corridor import a_rollout, config_of, network, train, weights
from torch import Generator, Tensor, nn

from negopipe.learning.acktr import Acktr, inner, kl_backtracking, trust_region_step
from negopipe.learning.learner import Learner
from negopipe.learning.update import forward
from negopipe.tensors.share import WHOLE


def learner_and_acktr(*overrides: str) -> tuple[Learner, Acktr]:
    """One update of the network is done."""
    learner = Learner(network(), config_of("acktr", *overrides), Generator().manual_seed(2))
    learner.update(a_rollout(), 0.0)
    assert isinstance(learner.algorithm, Acktr)
    return learner, learner.algorithm


def matrix(layer: nn.Linear | nn.Conv2d) -> Tensor:
    assert layer.bias is not None
    return torch.cat([layer.weight.detach().flatten(1), layer.bias.detach()[:, None]], 1).clone()


def test_trust_region_bounds_the_quadratic_form() -> None:
    quadratic = torch.tensor([0.0, 1e-6, 0.3, 50.0])
    eta = trust_region_step(quadratic, 0.001, 0.25)
    assert (0.5 * eta.square() * quadratic <= 0.001 * (1 + 1e-5)).all()
    assert eta[:2].tolist() == [0.25, 0.25]


def test_step_stays_within_the_undamped_trust_region() -> None:
    policy = network()
    config = config_of("acktr", "algorithm.momentum=0.0", "algorithm.minibatch_size=1000")
    learner = Learner(policy, config, Generator().manual_seed(2))
    assert isinstance(learner.algorithm, Acktr)
    kfac = learner.algorithm.kfac
    before = {name: matrix(layer) for name, layer in kfac.layers.items()}
    learner.update(a_rollout(), 0.0)
    bounds = {"policy": 0.0, "value": 0.0}
    for name, layer in kfac.layers.items():
        step, factors = matrix(layer) - before[name], kfac.factors[name]
        if name.startswith("value_head.2"):  # rescaling moved this layer too
            continue
        group = "value" if name.startswith("value_head") else "policy"
        bounds[group] += 0.5 * float((step * (factors.outputs @ step @ factors.inputs[0])).sum())
    assert 0 < bounds["policy"] <= config.kl_clip
    assert 0 < bounds["value"] <= config.value_kl_clip


def test_measured_kl_keeps_to_the_clips() -> None:
    _, _, metrics = train(config_of("acktr", "algorithm.kl_clip=0.002", "algorithm.value_kl_clip=0.005"), 25)
    assert max(m["kl"] for m in metrics) < 0.002 * 1.3
    assert max(m["value_kl"] for m in metrics) < 0.005 * 1.3
    assert max(m["kl"] for m in metrics) > 0.0005


def test_trust_regions_shrink_with_the_steps() -> None:
    """The measured KL is what binds, so steps of half the length need a bound of a quarter."""
    config = config_of("acktr", "algorithm.kl_clip=0.002", "algorithm.final_step_share=0.5")
    learner = Learner(network(), config, Generator().manual_seed(2))
    for _ in range(10):
        early = learner.update(a_rollout(), 0.0)
    late = learner.update(a_rollout(), 1.0)
    assert 0.25 * 0.002 * 1.3 < early["kl"] < 0.002 * 1.3
    assert 0 < late["kl"] < 0.25 * 0.002 * 1.3
    assert 0 < late["value_kl"] < 0.25 * config.value_kl_clip * 1.3


def test_shortening_makes_a_quadratic_kl_fit() -> None:
    kl = torch.tensor([0.0, 0.5, 4.0, torch.nan, torch.inf])
    share = kl_backtracking(kl, 1.0)
    assert share.tolist() == [1.0, 1.0, 0.5, 0.0, 0.0]


@pytest.mark.parametrize("poison", ["nan", "zero"])
def test_unusable_gradients_move_nothing(poison: str) -> None:
    learner, acktr = learner_and_acktr("algorithm.minibatch_size=1000")
    before = weights(learner.policy)
    gradient = {name: torch.zeros_like(matrix(layer)) for name, layer in acktr.kfac.layers.items()}
    if poison == "nan":
        gradient["policy_head.0"][0, 0] = torch.nan
    probe = torch.eye(7)
    acktr._descend(gradient, 1.0, (probe, forward(learner.policy, probe).first(7), WHOLE))
    assert torch.equal(before, weights(learner.policy))
    assert acktr.n_skipped == 1


def test_uphill_momentum_is_dropped() -> None:
    _, acktr = learner_and_acktr()
    gradient = {name: torch.ones_like(m) for name, m in acktr.momentum.items()}
    acktr.momentum = {name: -100 * g for name, g in gradient.items()}
    momentum, v = acktr._direction(gradient)
    assert all(torch.equal(momentum[name], gradient[name]) for name in gradient)
    assert inner(v, gradient) > 0


def test_state_is_contiguous() -> None:
    """As safetensors wants it."""
    learner, _ = learner_and_acktr()
    assert all(value.is_contiguous() for value in learner.state_dict().values())
