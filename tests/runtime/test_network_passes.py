"""The bare passes are those that an iteration cannot do without: as many, of as many decisions."""

import torch
from composed import compose_config
from torch import Tensor, nn

from negopipe.learning.update import minibatches
from negopipe.runtime.network_passes import forward_backward, iteration_passes, minibatch_sizes, random_observations
from negopipe.tensors.row_blocks import Elements, RowBlocks

CPU = torch.device("cpu")
SHAPE = (2, 5, 5)
UNEVEN = ("algorithm.n_worlds=5", "algorithm.n_steps=6", "algorithm.minibatch_size=16", "algorithm.n_epochs=2")


class CountingNetwork(nn.Module):
    """Notes of every pass how many grids it was of and whether with a gradient."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))
        self.passes: list[tuple[int, bool]] = []

    def forward(self, grids: Tensor) -> tuple[Tensor, Tensor]:
        self.passes.append((len(grids), torch.is_grad_enabled()))
        value = self.weight * grids.float().mean((1, 2, 3))
        return value[:, None], value


def test_every_decision_passes_once_forward_and_once_per_epoch_forward_and_backward() -> None:
    network = CountingNetwork()
    algorithm = compose_config(UNEVEN).algorithm
    iteration_passes(network, algorithm, SHAPE, CPU)()  # type: ignore[arg-type]
    assert network.passes == [(15, False)] * 2 + [(15, True)] * 4


def test_minibatches_are_of_the_learners_sizes() -> None:
    for size in (1, 7, 16, 29, 30, 1000):
        algorithm = compose_config([*UNEVEN, f"algorithm.minibatch_size={size}"]).algorithm
        assert minibatch_sizes(algorithm) == [len(part) for part in minibatches(30, size, torch.Generator())]


def test_gradients_do_not_add_up() -> None:
    network, grids = CountingNetwork(), random_observations(3, SHAPE, CPU)
    for _ in range(2):
        forward_backward(network, grids)  # type: ignore[arg-type]
    assert network.weight.grad is not None
    torch.testing.assert_close(network.weight.grad, 2 * grids.float().mean((1, 2, 3)).sum())


def test_random_rows_are_of_the_layout() -> None:
    rows = random_observations(3, RowBlocks(4, Elements(2, 5), Elements(3, 2)), CPU)
    assert (rows.shape, rows.dtype) == ((3, 20), torch.float32)


def test_random_grids_are_of_zeros_and_ones() -> None:
    grids = random_observations(3, SHAPE, CPU)
    assert (grids.shape, grids.dtype) == ((3, *SHAPE), torch.uint8)
    assert grids.unique().tolist() == [0, 1]
