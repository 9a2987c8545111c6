"""K-FAC against dense matrices and explicit loops."""

import pytest
import torch
from torch import Generator, Tensor, nn

from negopipe.learning.kfac import (
    Factors,
    Kfac,
    KfacConfig,
    damped_inverse,
    homogeneous_inputs,
    input_factor,
    kfac_layers,
    output_factor,
    precondition,
    record,
)

CONFIG = KfacConfig(
    damping=0.01,
    statistics_decay=0.9,
    statistics_interval=1,
    n_statistics=64,
    n_patches=10_000,
    inverse_interval=1,
    max_factor_size=1000,
)


def randn(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=Generator().manual_seed(sum(shape)))


def symmetric(n: int) -> Tensor:
    x = randn(2 * n, n)
    return x.T @ x / len(x)


def test_single_sample_of_a_linear_layer_gives_the_dense_fisher() -> None:
    layer, x = nn.Linear(3, 2), randn(1, 3)
    target = randn(1, 2)

    def loss() -> Tensor:
        return 0.5 * (layer(x) - target).square().sum()

    inputs, d = record({"l": layer}, loss)
    a, g = input_factor(layer, inputs["l"], 100)[0], output_factor(layer, d["l"])
    loss().backward()
    gradient = torch.cat([layer.weight.grad, layer.bias.grad[:, None]], 1).flatten()
    torch.testing.assert_close(torch.kron(g, a), torch.outer(gradient, gradient))


def test_natural_gradient_solves_the_damped_kronecker_system() -> None:
    a, g, gradient, damping = symmetric(4), symmetric(3), randn(3, 4), 0.1
    pi = ((a.trace() / 4) / (g.trace() / 3)).sqrt()
    dense = torch.kron(g + damping**0.5 / pi * torch.eye(3), a + pi * damping**0.5 * torch.eye(4))
    inverse = damped_inverse(Factors(a[None], g), 4, damping)
    assert inverse is not None
    expected = torch.linalg.solve(dense, gradient.flatten()).view(3, 4)
    torch.testing.assert_close(precondition(gradient, inverse), expected, atol=1e-4, rtol=1e-4)


def test_blocks_solve_the_block_diagonal_system() -> None:
    layer, x, gradient = nn.Linear(6, 2), randn(40, 6), randn(2, 7)
    full = input_factor(layer, x, 7)[0]
    blocks = input_factor(layer, x, 4)
    assert blocks.shape == (2, 4, 4)
    torch.testing.assert_close(blocks[0], full[:4, :4])
    torch.testing.assert_close(blocks[1, :3, :3], full[4:, 4:])
    assert blocks[1, 3].eq(0).all()
    g = symmetric(2)
    inverse = damped_inverse(Factors(blocks, g), 7, 0.1)
    assert inverse is not None
    pi = ((full.trace() / 7) / (g.trace() / 2)).sqrt()
    block_diagonal = torch.block_diag(full[:4, :4], full[4:, 4:]) + pi * 0.1**0.5 * torch.eye(7)
    dense = torch.kron(g + 0.1**0.5 / pi * torch.eye(2), block_diagonal)
    expected = torch.linalg.solve(dense, gradient.flatten()).view(2, 7)
    torch.testing.assert_close(precondition(gradient, inverse), expected, atol=1e-4, rtol=1e-4)


def test_convolution_factors_equal_a_loop_over_patches() -> None:
    layer, x = nn.Conv2d(2, 3, 2, stride=2), randn(4, 2, 6, 6)
    d = randn(4, 3, 3, 3)
    a, g = torch.zeros(9, 9), torch.zeros(3, 3)
    for n in range(4):
        for i in range(3):
            for j in range(3):
                patch = x[n, :, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2].flatten()
                patch = torch.cat([patch, torch.ones(1)])
                a += torch.outer(patch, patch) / 4
                g += torch.outer(d[n, :, i, j], d[n, :, i, j]) / (4 * 9)
    torch.testing.assert_close(input_factor(layer, x, 100)[0], a)
    torch.testing.assert_close(output_factor(layer, d), g)


def test_a_layer_that_elements_share_has_the_factors_of_a_loop_over_them() -> None:
    layer, x, d = nn.Linear(3, 2), randn(5, 4, 3), randn(5, 4, 2)
    a, g = torch.zeros(4, 4), torch.zeros(2, 2)
    for n in range(5):
        for i in range(4):
            row = torch.cat([x[n, i], torch.ones(1)])
            a += torch.outer(row, row) / 5
            g += torch.outer(d[n, i], d[n, i]) / (5 * 4)
    torch.testing.assert_close(input_factor(layer, x, 100)[0], a)
    torch.testing.assert_close(output_factor(layer, d), g)


def test_patches_are_in_the_order_of_the_weights() -> None:
    layer, x = nn.Conv2d(2, 3, 3, stride=2), randn(2, 2, 7, 7)
    weight = torch.cat([layer.weight.flatten(1), layer.bias[:, None]], 1)
    rows = homogeneous_inputs(layer, x) @ weight.T
    torch.testing.assert_close(rows.view(2, 9, 3).transpose(1, 2).view(2, 3, 3, 3), layer(x))


def fisher_loss(network: nn.Module) -> Tensor:
    return network(randn(64, 3)).square().sum()


def test_factors_are_averaged_with_the_decay_after_a_plain_start() -> None:
    network = nn.Sequential(nn.Linear(3, 2))
    kfac = Kfac(network, CONFIG)
    x = [randn(64, 3), 2 * randn(64, 3), 3 * randn(64, 3)]
    for batch in x:
        kfac.refresh(lambda _, batch=batch: network(batch).square().sum())
    single = [input_factor(network[0], batch, 100) for batch in x]
    # decays 0, 1/2, 2/3: still the plain mean, since 0.9 is larger
    torch.testing.assert_close(kfac.factors["0"].inputs, sum(single) / 3)


def test_schedule() -> None:
    network, calls = nn.Sequential(nn.Linear(3, 2)), []
    kfac = Kfac(network, CONFIG.__class__(**{**CONFIG.__dict__, "statistics_interval": 3, "inverse_interval": 4}))
    inverses = []
    for update in range(8):
        kfac.refresh(lambda _, update=update: calls.append(update) or fisher_loss(network) * (update + 1))
        inverses.append(kfac.inverses["0"])
    assert calls == [0, 3, 6]
    assert [i for i in range(1, 8) if inverses[i] is not inverses[i - 1]] == [4]


def test_unusable_statistics_are_skipped_and_counted() -> None:
    network = nn.Sequential(nn.Linear(3, 2))
    kfac = Kfac(network, CONFIG)
    kfac.refresh(lambda _: network(torch.full((4, 3), torch.nan)).sum())
    assert not kfac.is_ready
    assert kfac.n_failures == 1
    kfac.refresh(lambda _: fisher_loss(network))
    before = kfac.factors["0"].inputs
    kfac.refresh(lambda _: fisher_loss(network) * torch.nan)
    assert kfac.is_ready
    assert kfac.n_failures == 2
    assert torch.equal(before, kfac.factors["0"].inputs)


def test_singular_factors_are_inverted_with_damping() -> None:
    inverse = damped_inverse(Factors(torch.zeros(1, 4, 4), torch.zeros(3, 3)), 4, 0.01)
    assert inverse is not None
    assert precondition(randn(3, 4), inverse).isfinite().all()


def test_indefinite_factor_is_retried_with_more_damping() -> None:
    indefinite = torch.diag(torch.tensor([1.0, -0.3]))
    inverse = damped_inverse(Factors(indefinite[None], torch.eye(2)), 2, 1e-4)
    assert inverse is not None
    assert (torch.linalg.eigvalsh(inverse.inputs[0]) > 0).all()


def test_parameters_outside_its_layers_are_refused() -> None:
    with pytest.raises(ValueError, match="K-FAC handles"):
        kfac_layers(nn.Sequential(nn.Linear(3, 3), nn.LayerNorm(3)))
    with pytest.raises(ValueError, match="K-FAC handles"):
        kfac_layers(nn.Sequential(nn.Linear(3, 3, bias=False)))
