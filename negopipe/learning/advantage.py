"""k-step returns and advantages (Eq. 6)."""

import torch
from torch import Tensor

from negopipe.learning.rollout import Rollout


def k_step_return(rollout: Rollout, gamma: float, k: int) -> Tensor:
    """The return of the next k steps plus the discounted value of the state reached, [T, E] float32.

    R^k_t = sum_{i<k} gamma^i r_{t+i} + gamma^k V(s_{t+k}), cut short where the rollout or the episode ends:
    the rollout's end bootstraps with V of the last state, a truncation with V of the episode's final state,
    a termination with nothing. (Reading: the value stands once, outside the sum of Eq. 6.)

    Computed by k sweeps of R^n_t = r_t + gamma R^{n-1}_{t+1}, from R^0 = V.
    """
    is_done = rollout.is_terminated | rollout.is_truncated
    end_value = torch.where(rollout.is_terminated, 0.0, rollout.final_value)
    returns = rollout.value
    for _ in range(min(k, len(rollout.reward))):
        successor = torch.cat([returns[1:], rollout.last_value[None]])
        returns = rollout.reward + gamma * torch.where(is_done, end_value, successor)
    return returns


def k_step_advantage(rollout: Rollout, gamma: float, k: int) -> tuple[Tensor, Tensor]:
    """Advantage A_t = R^k_t - V(s_t) and the return R^k_t that the value is regressed to, both [T, E]."""
    returns = k_step_return(rollout, gamma, k)
    return returns - rollout.value, returns
