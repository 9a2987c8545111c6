"""Adam with the paper's two rates, one for the policy and its encoder and one for the value head."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from negopipe.learning.update import Decisions, Outputs, UpdateConfig, differentiate, measure_kl, probe
from negopipe.policy.actor_critic import ActorCritic
from negopipe.schema import PositiveFloat, schema


@schema
class AdamConfig:
    """Adam (Kingma & Ba 2015).

    policy_rate: learning rate of the encoder and the policy head; the paper's is 1e-4
    value_rate: learning rate of the value head; the paper's is 1e-3
    """

    policy_rate: PositiveFloat
    value_rate: PositiveFloat


@schema
class FirstOrderConfig(UpdateConfig):
    """Options of the first-order algorithms, beside those of all algorithms.

    adam: rates
    gradient_norm_max: largest norm of the gradient, to which a longer one is scaled
    """

    adam: AdamConfig
    gradient_norm_max: PositiveFloat


class TwoRateAdam:
    """Adam on the gradients that a backward pass has left at the policy's parameters."""

    def __init__(self, policy: ActorCritic, config: AdamConfig) -> None:
        self._rates = (config.policy_rate, config.value_rate)
        self._parameters = dict(policy.named_parameters())
        value = list(policy.value_head.parameters())
        others = [*policy.encoder.parameters(), *policy.policy_head.parameters()]
        self._adam = torch.optim.Adam(
            [{"params": others, "lr": self._rates[0]}, {"params": value, "lr": self._rates[1]}]
        )
        self.n_skipped = 0

    def step(self, shrink: float) -> None:
        """One step at `shrink` times the rates; it is skipped where a gradient is not finite or all are zero."""
        gradients = [p.grad for p in self._parameters.values() if p.grad is not None]
        norm = nn.utils.get_total_norm(gradients)
        if not (bool(norm.isfinite()) and bool(norm > 0)):
            self.n_skipped += 1
            return
        for group, rate in zip(self._adam.param_groups, self._rates, strict=True):
            group["lr"] = shrink * rate
        self._adam.step()

    def state_dict(self) -> dict[str, Tensor]:
        state = {"n_skipped": torch.tensor(self.n_skipped)}
        for name, parameter in self._parameters.items():
            for key, value in self._adam.state[parameter].items():
                state[f"{name}/{key}"] = value
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.n_skipped = int(state["n_skipped"])
        self._adam.state.clear()
        for place, value in state.items():
            name, _, key = place.rpartition("/")
            if name:
                parameter = self._parameters[name]
                like = value if key == "step" else value.to(parameter).contiguous(memory_format=_format_of(parameter))
                self._adam.state[parameter][key] = like


class FirstOrder:
    """Adam down the gradient of a loss; satisfies `negopipe.learning.update.Algorithm`.

    policy_loss: differentiable function of the network's outputs for a minibatch
    """

    def __init__(
        self, policy: ActorCritic, config: FirstOrderConfig, policy_loss: Callable[[Outputs, Decisions], Tensor]
    ) -> None:
        self.policy, self.config, self.policy_loss = policy, config, policy_loss
        self.adam = TwoRateAdam(policy, config.adam)

    @property
    def n_skipped(self) -> int:
        return self.adam.n_skipped

    def step(self, batch: Decisions, progress: float) -> dict[str, Tensor]:
        config, policy = self.config, self.policy
        outputs, parts = differentiate(policy, batch, self.policy_loss, config, progress)
        nn.utils.clip_grad_norm_(policy.parameters(), config.gradient_norm_max)
        self.adam.step(self.config.step_share(progress))
        return {**parts, **measure_kl(policy, *probe(batch, outputs, config.n_probe))}

    def state_dict(self) -> dict[str, Tensor]:
        return self.adam.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.adam.load_state_dict(state)


def _format_of(parameter: Tensor) -> torch.memory_format:
    """Memory format of a parameter; moments in the format of their weights give the same sums."""
    is_last = parameter.dim() == 4 and parameter.is_contiguous(memory_format=torch.channels_last)
    return torch.channels_last if is_last else torch.contiguous_format
