"""Bare passes of the network: the part of an iteration that no implementation can leave out."""

from collections.abc import Callable

import torch
from torch import Tensor

from negopipe.learning.learner import AnyAlgorithmConfig
from negopipe.policy.actor_critic import ActorCritic


def random_grids(n: int, shape: tuple[int, int, int], device: torch.device) -> Tensor:
    """[n, C, H, W] uint8 on `device`, 0 or 1: a network's speed does not depend on its input."""
    grids = torch.randint(0, 2, (n, *shape), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    return grids.to(device)


@torch.no_grad()
def forward(policy: ActorCritic, grids: Tensor) -> None:
    policy(grids)


def forward_backward(policy: ActorCritic, grids: Tensor) -> None:
    """Forward and backward pass; a gradient is left at every weight."""
    policy.zero_grad(set_to_none=True)
    logits, value = policy(grids)
    (logits.sum() + value.sum()).backward()


def minibatch_sizes(algorithm: AnyAlgorithmConfig) -> list[int]:
    """Sizes of the minibatches of an iteration."""
    n = algorithm.n_worlds * algorithm.n_steps
    return [len(part) for part in torch.arange(n).chunk(-(-n // algorithm.minibatch_size))]


def iteration_passes(
    policy: ActorCritic, algorithm: AnyAlgorithmConfig, shape: tuple[int, int, int], device: torch.device
) -> Callable[[], None]:
    """The passes of an iteration: each decision forward once, and forward and backward once per epoch.

    The forward passes are made in minibatches as well, where collecting makes them `n_worlds` at a time; in
    larger batches the network is faster, so what an iteration is held against is as short as it can be.
    """
    sizes = minibatch_sizes(algorithm)
    grids = random_grids(max(sizes), shape, device)

    def passes() -> None:
        for size in sizes:
            forward(policy, grids[:size])
        for size in sizes * algorithm.n_epochs:
            forward_backward(policy, grids[:size])

    return passes
