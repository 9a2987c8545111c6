"""The reward (Eq. 3)."""

import torch
from torch import Tensor

from negopipe.schema import Real, schema


@schema
class RewardConfig:
    """Reward per event; `conf/reward/` has both of the paper's readings.

    step: at every decision, the last one included (docs/reading.md, "reward")
    collision: once, at the collision that ends the episode
    success: once, when all vehicles have reached their targets
    """

    step: Real
    collision: Real
    success: Real


def reward(config: RewardConfig, is_collision: Tensor, is_success: Tensor) -> Tensor:
    """[E] float32: reward of one decision; `is_collision` and `is_success` [E] bool."""
    value = torch.full_like(is_collision, config.step, dtype=torch.float32)
    value = value + config.collision * is_collision
    return value + config.success * is_success
