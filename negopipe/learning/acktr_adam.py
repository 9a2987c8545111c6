"""The direction of ACKTR with Adam as the step rule; the paper names both.

v     = F_hat^-1 grad L
theta <- Adam(theta, v), with the paper's rates for policy and value
"""

from typing import Literal

from torch import Generator, Tensor

from negopipe.learning.acktr import NaturalGradientConfig, refresh
from negopipe.learning.adam import AdamConfig, TwoRateAdam
from negopipe.learning.kfac import Kfac
from negopipe.learning.update import Decisions, differentiate, measure_kl, policy_gradient_loss, probe
from negopipe.policy.actor_critic import ActorCritic
from negopipe.schema import schema
from negopipe.tensors.prefixes import add_prefix, strip_prefix


@schema
class AcktrAdamConfig(NaturalGradientConfig):
    """Options of ACKTR with Adam, beside those of all algorithms that follow the natural gradient.

    adam: rates
    """

    kind: Literal["acktr_adam"]
    adam: AdamConfig


class AcktrAdam:
    """ACKTR with Adam for a policy; satisfies `negopipe.learning.update.Algorithm`.

    generator: samples the targets of the Fisher matrix; on the policy's device
    """

    def __init__(self, policy: ActorCritic, config: AcktrAdamConfig, generator: Generator) -> None:
        self.policy, self.config, self.generator = policy, config, generator
        self.kfac = Kfac(policy, config.kfac)
        self.adam = TwoRateAdam(policy, config.adam)

    @property
    def n_skipped(self) -> int:
        """Number of updates, statistics and inversions that were skipped."""
        return self.adam.n_skipped + self.kfac.n_failures

    def step(self, batch: Decisions, progress: float) -> dict[str, Tensor]:
        refresh(self.kfac, self.policy, batch, self.generator)
        outputs, parts = differentiate(self.policy, batch, policy_gradient_loss, self.config, progress)
        if self.kfac.is_ready:
            self.kfac.set_gradient(self.kfac.natural_gradient(self.kfac.gradient()))
        else:
            self.policy.zero_grad(set_to_none=False)
        self.adam.step(self.config.step_share(progress))
        return {**parts, **measure_kl(self.policy, *probe(batch, outputs, self.config.n_probe))}

    def state_dict(self) -> dict[str, Tensor]:
        return add_prefix("kfac", self.kfac.state_dict()) | add_prefix("adam", self.adam.state_dict())

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.kfac.load_state_dict(strip_prefix("kfac", state))
        self.adam.load_state_dict(strip_prefix("adam", state))
