"""Passes of the network alone: the part of an iteration that every implementation has."""

from collections.abc import Callable

import torch
from torch import Tensor

from negopipe.learning.learner import AnyAlgorithmConfig
from negopipe.policy.actor_critic import ActorCritic


def random_grids(n: int, shape: tuple[int, int, int], device: torch.device) -> Tensor:
    """Random grids [n, C, H, W] uint8, 0 or 1, on `device`, for timings: a network's speed does not depend on them."""
    grids = torch.randint(0, 2, (n, *shape), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    return grids.to(device)


@torch.no_grad()
def forward(policy: ActorCritic, grids: Tensor) -> None:
    """Forward pass without gradients."""
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
    """The passes of an iteration: forward once per decision, and forward and backward once per decision and epoch.

    The forward passes are made in minibatches too, although the collection makes them `n_worlds` at a time. The network
    is faster in larger batches, so this is a lower bound on the time of an iteration.
    """
    sizes = minibatch_sizes(algorithm)
    grids = random_grids(max(sizes), shape, device)

    def passes() -> None:
        for size in sizes:
            forward(policy, grids[:size])
        for size in sizes * algorithm.n_epochs:
            forward_backward(policy, grids[:size])

    return passes
