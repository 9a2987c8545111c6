"""The reward (Eq. 3)."""

from collections.abc import Iterator

import torch
from torch import Tensor

from negopipe.checks import Problem
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

    def check_searchable(self, key: str, user: str) -> Iterator[Problem]:
        """A search gives up what can no longer win, which is exact only where what takes longer pays less.

        key: of this reward; user: key of the search
        """
        if self.step > 0 or self.collision > 0 or self.success < 0:
            rule = f"have step <= 0, collision <= 0 and success >= 0 for {user}"
            yield Problem(key, rule, f"{self.step}, {self.collision}, {self.success}")


def reward(config: RewardConfig, is_collision: Tensor, is_success: Tensor) -> Tensor:
    """[E] float32: reward of one decision; `is_collision` and `is_success` [E] bool."""
    value = torch.full_like(is_collision, config.step, dtype=torch.float32)
    value = value + config.collision * is_collision
    return value + config.success * is_success
