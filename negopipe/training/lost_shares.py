"""What a policy has learned least: the share of lost episodes by driver and by street."""

import torch
from torch import Tensor

DECAY = 0.99
"""Weight of the earlier episodes in a share, at every new episode."""
LEAST_LOST = 0.05
"""Share with which everything counts at least, so that nothing is forgotten."""


class LostShares:
    """Share of the episodes that were not won with each of K drivers, or on each of K streets.

    shares: [K] float64, a running mean over episodes; 1 at first
    """

    def __init__(self, n: int, device: torch.device) -> None:
        self.shares = torch.ones(n, dtype=torch.float64, device=device)

    def record(self, index: Tensor, is_success: Tensor) -> None:
        """Count episodes that are over; index: [N] int64, of the driver or the street; is_success: [N] bool."""
        n = torch.zeros_like(self.shares).index_add_(0, index, torch.ones_like(index, dtype=torch.float64))
        n_lost = torch.zeros_like(self.shares).index_add_(0, index, (~is_success).double())
        new = n_lost / n.clamp(min=1)
        self.shares = new + DECAY**n * (self.shares - new)

    def weigh(self, weights: Tensor, hard_share: float) -> Tensor:
        """[K] float64: the `weights` [K], with a share of their sum in proportion to what is lost."""
        lost = weights * self.shares.clamp(min=LEAST_LOST)
        return (1 - hard_share) * weights + hard_share * weights.sum() * lost / lost.sum()
