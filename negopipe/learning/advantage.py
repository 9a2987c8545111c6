"""Returns and advantages: of k steps (Eq. 6), or an average over all k (Schulman et al. 2016)."""

from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor

from negopipe.learning.rollout import Rollout
from negopipe.schema import Fraction, PositiveInt, schema


@schema
class KStepConfig:
    """The paper's Eq. 6.

    n_return_steps: k
    """

    kind: Literal["k_step"]
    n_return_steps: PositiveInt


@schema
class GaeConfig:
    """Generalised advantage estimation.

    gae_lambda: lambda; 0 = one step, 1 = all steps of the rollout
    """

    kind: Literal["gae"]
    gae_lambda: Fraction


AdvantageConfig = Annotated[KStepConfig | GaeConfig, Field(discriminator="kind")]


def estimate_advantage(rollout: Rollout, gamma: float, config: KStepConfig | GaeConfig) -> tuple[Tensor, Tensor]:
    """Advantage A_t = R_t - V(s_t) and the return R_t that the value is regressed to, both [T, E] float32."""
    if isinstance(config, GaeConfig):
        returns = lambda_return(rollout, gamma, config.gae_lambda)
    else:
        returns = k_step_return(rollout, gamma, config.n_return_steps)
    return returns - rollout.value, returns


def k_step_return(rollout: Rollout, gamma: float, k: int) -> Tensor:
    """The return of the next k steps plus the discounted value of the state reached, [T, E] float32.

    R^k_t = sum_{i<k} gamma^i r_{t+i} + gamma^k V(s_{t+k}), with fewer steps where the rollout or the episode ends.
    The end of the rollout bootstraps with V of the last state, a truncation with V of the episode's final state,
    a termination with 0. The value stands once, outside the sum of Eq. 6 (docs/reading.md, "advantage").

    It is computed by k sweeps of R^n_t = r_t + gamma R^{n-1}_{t+1}, from R^0 = V.
    """
    is_done, end_value = _ends(rollout)
    returns = rollout.value
    for _ in range(min(k, len(rollout.reward))):
        successor = torch.cat([returns[1:], rollout.last_value[None]])
        returns = rollout.reward + gamma * torch.where(is_done, end_value, successor)
    return returns


def lambda_return(rollout: Rollout, gamma: float, gae_lambda: float) -> Tensor:
    """The average of all k-step returns, (1 - lambda) sum_k lambda^{k-1} R^k_t, [T, E] float32.

    The steps end as in `k_step_return`, and the remaining weights fall to the longest return. Less V(s_t) it is the
    generalised advantage (Schulman et al. 2016, Eq. 16).

    It is computed backwards: R_t = r_t + gamma ((1 - lambda) V(s_{t+1}) + lambda R_{t+1}).
    """
    is_done, end_value = _ends(rollout)
    returns = torch.empty_like(rollout.reward)
    value, later = rollout.last_value, rollout.last_value
    for t in reversed(range(len(returns))):
        ahead = torch.where(is_done[t], end_value[t], value.lerp(later, gae_lambda))
        later = returns[t] = rollout.reward[t] + gamma * ahead
        value = rollout.value[t]
    return returns


def _ends(rollout: Rollout) -> tuple[Tensor, Tensor]:
    """[T, E] each: whether the episode ends with this step, and the value of its final state."""
    return rollout.is_done, torch.where(rollout.is_terminated, 0.0, rollout.final_value)
