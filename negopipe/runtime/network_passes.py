"""Passes of the network alone: the part of an iteration that every implementation has."""

from collections.abc import Callable

import torch
from torch import Tensor

from negopipe.learning.learner import AnyAlgorithmConfig
from negopipe.policy.actor_critic import ActorCritic
from negopipe.policy.kinds import ObservationLayout
from negopipe.tensors.row_blocks import RowBlocks


def random_observations(n: int, layout: ObservationLayout, device: torch.device) -> Tensor:
    """Random observations on `device`, for timings: a network's speed does not depend on them.

    Grids [n, C, H, W] uint8, 0 or 1, or rows [n, numbers] float32.
    """
    random = torch.Generator().manual_seed(0)
    if isinstance(layout, RowBlocks):
        return torch.randn(n, layout.n_numbers, generator=random).to(device)
    return torch.randint(0, 2, (n, *layout), dtype=torch.uint8, generator=random).to(device)


@torch.no_grad()
def forward(policy: ActorCritic, observations: Tensor) -> None:
    """Forward pass without gradients."""
    policy(observations)


def forward_backward(policy: ActorCritic, observations: Tensor) -> None:
    """Forward and backward pass; a gradient is left at every weight."""
    policy.zero_grad(set_to_none=True)
    logits, value = policy(observations)
    (logits.sum() + value.sum()).backward()


def minibatch_sizes(algorithm: AnyAlgorithmConfig) -> list[int]:
    """Sizes of the minibatches of an iteration."""
    n = algorithm.n_worlds * algorithm.n_steps
    return [len(part) for part in torch.arange(n).chunk(-(-n // algorithm.minibatch_size))]


def iteration_passes(
    policy: ActorCritic, algorithm: AnyAlgorithmConfig, layout: ObservationLayout, device: torch.device
) -> Callable[[], None]:
    """The passes of an iteration: forward once per decision, and forward and backward once per decision and epoch.

    The forward passes are made in minibatches too, although the collection makes them `n_worlds` at a time. The network
    is faster in larger batches, so this is a lower bound on the time of an iteration.
    """
    sizes = minibatch_sizes(algorithm)
    observations = random_observations(max(sizes), layout, device)

    def passes() -> None:
        for size in sizes:
            forward(policy, observations[:size])
        for size in sizes * algorithm.n_epochs:
            forward_backward(policy, observations[:size])

    return passes
