"""A2C: advantage actor-critic (Mnih et al. 2016), with Adam.

L   = -1/N sum A_t log pi(a_t|s_t) + c_V L_V - c_H H
theta <- Adam(theta, grad L)
"""

from typing import Literal

from negopipe.learning.adam import FirstOrder, FirstOrderConfig
from negopipe.learning.update import policy_gradient_loss
from negopipe.policy.actor_critic import ActorCritic
from negopipe.schema import schema


@schema
class A2cConfig(FirstOrderConfig):
    """Options of A2C: those of all first-order algorithms."""

    kind: Literal["a2c"]


def a2c(policy: ActorCritic, config: A2cConfig) -> FirstOrder:
    """A2C for a policy."""
    return FirstOrder(policy, config, policy_gradient_loss)
