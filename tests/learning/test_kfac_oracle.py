"""K-FAC against curvlinops, which computes the same factors in its own way; and factors that are hard to invert.

Symbols as in negopipe/learning/kfac.py; A' and G' are curvlinops' factors of the summed loss, positions expanded.
Over a convolution's S positions it takes the mean in A' and the sum in G', over the N samples the sum in G':

    A = S A'    G = G' / (N S)    F = A (x) G = A' (x) G' / N

K-FAC computes in float32. For the comparison it gets float64, so that what rounding leaves is below 1e-12.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from curvlinops import KFACInverseLinearOperator, KFACLinearOperator
from torch import Generator, Tensor, nn

from negopipe.learning.kfac import (
    Factors,
    Kfac,
    KfacConfig,
    damped_inverse,
    fisher_loss,
    input_factor,
    kfac_layers,
    layer_gradient,
    n_positions,
    output_factor,
    precondition,
    record,
)
from negopipe.policy.actor_critic import ActorCritic, mlp, sample_action

N = 6
SEED = 5
DAMPING = 0.01
NOISE_STD = math.sqrt(0.5)
"""(f - y)^2 is the negative log-likelihood of a Gaussian of this width."""
LOSSES = {"softmax": nn.CrossEntropyLoss(reduction="sum"), "gaussian": nn.MSELoss(reduction="sum")}

networks = pytest.mark.parametrize("kind", ["linear", "convolution", "elements"])
heads = pytest.mark.parametrize("head", LOSSES)
Loss = Callable[[Tensor], Tensor]


@pytest.fixture
def float64(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(Tensor, "float", Tensor.double)
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


class Largest(nn.Module):
    """The largest values of elements [N, S, m] -> [N, m]."""

    def forward(self, elements: Tensor) -> Tensor:
        return elements.amax(1)


def randn(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=Generator().manual_seed(sum(shape)))


def case(kind: str) -> tuple[nn.Sequential, Tensor]:
    """A network with three outputs and a batch for it."""
    if kind == "linear":
        network, x = nn.Sequential(nn.Linear(4, 5), nn.Tanh(), nn.Linear(5, 3)), randn(N, 4)
    elif kind == "elements":  # two layers that seven elements share, then their largest values
        shared = (nn.Linear(4, 5), nn.Tanh(), nn.Linear(5, 4), nn.Tanh())
        network, x = nn.Sequential(*shared, Largest(), nn.Linear(4, 3)), randn(N, 7, 4)
    else:
        first, second = nn.Conv2d(2, 3, 3, stride=2, padding=1), nn.Conv2d(3, 4, (2, 3))
        network = nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), nn.Flatten(), nn.Linear(16, 3))
        x = randn(N, 2, 6, 8)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.5, generator=Generator().manual_seed(parameter.numel()))
    return network, x


def labels(head: str) -> Tensor:
    return torch.arange(N) % 3 if head == "softmax" else randn(N, 3)


def expected_losses(head: str, output: Tensor) -> list[Loss]:
    """Losses whose output factors add up to the expectation over all targets that the network could draw.

    softmax: one per class; the root of the class's probability weights the gradient.
    gaussian: the gradient is linear in the noise, so a step along each axis has the noise's covariance.
    """
    if head == "gaussian":
        return [lambda f, e=e: (f - output - NOISE_STD * e).square().sum() for e in torch.eye(3)]
    root = output.softmax(-1).sqrt()
    return [lambda f, c=c: -(root[:, c] * f.log_softmax(-1)[:, c]).sum() for c in range(3)]


def losses_of(fisher_type: str, head: str, output: Tensor) -> list[Loss]:
    if fisher_type == "type-2":
        return expected_losses(head, output)
    target, generator = labels(head), Generator().manual_seed(SEED)
    if fisher_type == "mc" and head == "softmax":
        target = sample_action(output, generator)
    elif fisher_type == "mc":
        target = output + NOISE_STD * torch.randn(output.shape, generator=generator)
    return [lambda f: LOSSES[head](f, target)]


def our_factors(network: nn.Module, x: Tensor, losses: list[Loss]) -> dict[str, Factors]:
    layers = kfac_layers(network)
    inputs, d = zip(*(record(layers, lambda loss=loss: loss(network(x))) for loss in losses), strict=True)
    return {
        name: Factors(input_factor(layer, inputs[0][name], 1000), sum(output_factor(layer, each[name]) for each in d))
        for name, layer in layers.items()
    }


def oracle(network: nn.Module, head: str, x: Tensor, fisher_type: str, **changes: Any) -> KFACLinearOperator:
    options: dict[str, Any] = {
        "loss_func": LOSSES[head],
        "data": [(x, labels(head))],
        "fisher_type": fisher_type,
        "seed": SEED,
        "check_deterministic": False,
        "separate_weight_and_bias": False,
    }
    operator = KFACLinearOperator(network, params=list(network.parameters()), **options | changes)
    operator.compute_kronecker_factors()
    return operator


def compare(network: nn.Module, x: Tensor, ours: dict[str, Factors], theirs: KFACLinearOperator) -> None:
    """A = S A', G = G' / (N S) in every layer."""
    outputs = dict.fromkeys(ours, x)
    for name in ours:
        network.get_submodule(name).register_forward_hook(lambda *args, name=name: outputs.update({name: args[2]}))
    network(x)
    for name, factors in ours.items():
        positions = n_positions(network.get_submodule(name), outputs[name])  # type: ignore[arg-type]
        a, g = theirs._input_covariances[name], theirs._gradient_covariances[name]
        torch.testing.assert_close(factors.inputs[0], positions * a, rtol=1e-12, atol=1e-13)
        torch.testing.assert_close(factors.outputs, g / (N * positions), rtol=1e-12, atol=1e-13)


@networks
@heads
@pytest.mark.parametrize("fisher_type", ["empirical", "mc", "type-2"])
@pytest.mark.usefixtures("float64")
def test_factors_equal_the_oracles(kind: str, head: str, fisher_type: str) -> None:
    """From given targets, from the same sampled ones, and in expectation over all that could be sampled."""
    network, x = case(kind)
    ours = our_factors(network, x, losses_of(fisher_type, head, network(x).detach()))
    assert len(ours) == {"linear": 2, "convolution": 3, "elements": 3}[kind]
    compare(network, x, ours, oracle(network, head, x, fisher_type))


@pytest.mark.parametrize(
    "change",
    [
        {"loss_func": nn.CrossEntropyLoss(reduction="mean")},
        {"kfac_approx": "reduce"},
        {"fisher_type": "empirical"},
        {"seed": SEED + 1},
    ],
    ids=str,
)
@pytest.mark.usefixtures("float64")
def test_another_oracle_is_told_apart(change: dict[str, Any]) -> None:
    network, x = case("convolution")
    ours = our_factors(network, x, losses_of("mc", "softmax", network(x).detach()))
    with pytest.raises(AssertionError, match="not close"):
        compare(network, x, ours, oracle(network, "softmax", x, **{"fisher_type": "mc"} | change))


@networks
@heads
@pytest.mark.usefixtures("float64")
def test_natural_gradient_equals_the_oracles(kind: str, head: str) -> None:
    """The damping is shared by the same rule; of F' = N F, N times the damping gives F_hat' = N F_hat."""
    network, x = case(kind)
    factors = our_factors(network, x, losses_of("type-2", head, network(x).detach()))
    LOSSES[head](network(x), labels(head)).backward()
    operator = KFACInverseLinearOperator(
        oracle(network, head, x, "type-2"), damping=N * DAMPING, use_heuristic_damping=True
    )
    theirs = iter(operator @ [parameter.grad for parameter in network.parameters()])
    for name, layer in kfac_layers(network).items():
        gradient = layer_gradient(layer)
        inverse = damped_inverse(factors[name], gradient.shape[1], DAMPING)
        assert inverse is not None
        weight, bias = next(theirs), next(theirs)
        expected = N * torch.cat([weight.flatten(1), bias[:, None]], 1)
        torch.testing.assert_close(precondition(gradient, inverse), expected, rtol=1e-10, atol=1e-12)


def test_fisher_loss_samples_the_sum_of_both_heads_fishers() -> None:
    """The heads' targets are independent, so the encoder's factor is the sum of two expectations.

    Many samples of one observation; the error of a mean over them is about 1 / sqrt(n).
    """
    generator, n = Generator().manual_seed(0), 40_000
    policy = ActorCritic(nn.Sequential(mlp((3, 4)), nn.Tanh()), 4, (), 3, torch.float32, generator)
    for parameter in policy.parameters():
        nn.init.normal_(parameter, generator=generator)
    policy.rescale_value(torch.tensor(2.0), torch.tensor(5.0), keep_value=False)
    x = randn(1, 3)
    _, d = record(kfac_layers(policy), lambda: fisher_loss(policy, x.expand(n, -1), generator))
    expected = torch.zeros(4, 4)
    for head, target, loss in (
        (policy.policy_head, torch.zeros(1, dtype=torch.int64), LOSSES["softmax"]),
        (policy.value_head, torch.zeros(1, 1), LOSSES["gaussian"]),
    ):
        network = nn.Sequential(policy.encoder, head)
        operator = oracle(network, "softmax", x, "type-2", loss_func=loss, data=[(x, target)])
        scale = 0.5 if head is policy.value_head else 1.0  # of a unit Gaussian
        expected += scale * operator._gradient_covariances["0.0.0"]
    actual = output_factor(policy.encoder[0][0], d["encoder.0.0"])
    assert (actual - expected).norm() < 0.05 * expected.norm()


@pytest.mark.parametrize("input_scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("gradient_scale", [0.0, 1e-3, 1.0, 1e3])
def test_a_single_sample_gives_a_descent_direction(input_scale: float, gradient_scale: float) -> None:
    """Factors of rank one, or zero behind a dead unit; the largest need more damping than is asked for."""
    layer, x, d = nn.Linear(40, 12), input_scale * randn(1, 40), gradient_scale * randn(1, 12)
    inverse = damped_inverse(Factors(input_factor(layer, x, 16), output_factor(layer, d)), 41, DAMPING)
    assert inverse is not None
    gradient = randn(12, 41)
    v = precondition(gradient, inverse)
    assert v.isfinite().all()
    assert (v * gradient).sum() > 0


def test_a_layer_that_cannot_be_inverted_keeps_its_inverse() -> None:
    hopeless = Factors(torch.diag(torch.tensor([1.0, -1e9]))[None], torch.eye(3))
    assert damped_inverse(hopeless, 2, DAMPING) is None
    usable = Factors(torch.eye(2)[None], torch.eye(3))
    config = KfacConfig(
        damping=DAMPING,
        statistics_decay=0.9,
        statistics_interval=1,
        n_statistics=N,
        n_patches=N,
        inverse_interval=1,
        max_factor_size=100,
    )
    kfac = Kfac(nn.Sequential(nn.Linear(1, 3)), config)
    kfac.factors = {"0": hopeless}
    kfac._invert()
    assert kfac.n_failures == 1
    torch.testing.assert_close(kfac.natural_gradient({"0": torch.ones(3, 2)})["0"], torch.ones(3, 2))
    kfac.factors = {"0": usable}
    kfac._invert()
    before = kfac.inverses["0"]
    kfac.factors = {"0": hopeless}
    kfac._invert()
    assert kfac.n_failures == 2
    assert kfac.inverses["0"] is before
