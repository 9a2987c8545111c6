"""PPO: proximal policy optimisation with a clipped objective (Schulman et al. 2017), with Adam.

rho_t = pi(a_t|s_t) / pi_old(a_t|s_t), with pi_old the policy that took the decision
L     = -1/N sum min(rho_t A_t, clip(rho_t, 1 - eps, 1 + eps) A_t) + c_V L_V - c_H H
theta <- Adam(theta, grad L)
"""

from functools import partial
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor

from negopipe.learning.adam import FirstOrder, FirstOrderConfig
from negopipe.learning.update import Decisions, Outputs
from negopipe.policy.actor_critic import ActorCritic
from negopipe.schema import schema


@schema
class PpoConfig(FirstOrderConfig):
    """Options of PPO, beside those of all first-order algorithms.

    clip: eps
    """

    kind: Literal["ppo"]
    clip: Annotated[float, Field(gt=0, lt=1)]


def ppo(policy: ActorCritic, config: PpoConfig) -> FirstOrder:
    """PPO for a policy."""
    return FirstOrder(policy, config, partial(clipped_loss, clip=config.clip))


def clipped_loss(outputs: Outputs, batch: Decisions, clip: float) -> Tensor:
    """-1/N sum min(rho A, clip(rho) A), without a gradient that would move rho farther than `clip` from 1."""
    ratio = (outputs.log_prob(batch.action) - batch.log_prob).exp()
    clipped = ratio.clamp(1 - clip, 1 + clip)
    return -batch.share.mean(torch.minimum(ratio * batch.advantage, clipped * batch.advantage))
