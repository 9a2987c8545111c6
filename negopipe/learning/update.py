"""The parts of an update that all algorithms share: a minibatch, its losses, and the measured KL of a step.

policy gradient   L_pi = -1/N sum A_t log pi(a_t|s_t)
imitation         L_pi = 1/N sum_t sum_a q(a|s_t) log[q(a|s_t) / pi(a|s_t)]     in its place, with a teacher q
value             L_V  = 1/(2N) sum (R_t - V(s_t))^2 / sigma^2
entropy           H    = -1/N sum_t sum_a pi(a|s_t) log pi(a|s_t)
together          L    = L_pi + c_V L_V - c_H H
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from pydantic import model_validator
from torch import Generator, Tensor

from negopipe.checks import FLOAT_BYTES, N_COPIES, Memory, Observed
from negopipe.learning.advantage import AdvantageConfig
from negopipe.policy.actor_critic import ActorCritic, log_prob_of
from negopipe.policy.size import Layers
from negopipe.schema import Fraction, NonNegativeFloat, PositiveFloat, PositiveInt, schema
from negopipe.tensors.share import WHOLE, Share


@schema
class EntropyPenaltyConfig:
    """Entropy penalty phase: the end of a training, in which low entropy is rewarded.

    The actions drawn in training then become the most probable ones, which are those of the evaluation.

    start: share of the training after which c_H is -coefficient
    """

    start: Fraction
    coefficient: PositiveFloat


@schema
class UpdateConfig:
    """One iteration: the size of the rollout, and the options of all algorithms' updates.

    n_worlds, n_steps: E worlds with T decisions each per iteration
    n_epochs: number of updates in which each decision is used
    minibatch_size: largest number of decisions per update
    gamma: discount per decision
    advantage: estimator of the advantage
    value_coefficient, entropy_coefficient: c_V, c_H
    return_decay: weight of the old return statistics when a rollout comes in; smaller at the start
    final_step_share: share of their length to which the steps shrink linearly by the end of training
    final_entropy_share: share to which c_H shrinks likewise
    entropy_penalty: null = c_H keeps its sign to the end
    n_probe: decisions of the minibatch on which the KL of an update is measured
    """

    n_worlds: PositiveInt
    n_steps: PositiveInt
    n_epochs: PositiveInt
    minibatch_size: PositiveInt
    gamma: Fraction
    advantage: AdvantageConfig
    value_coefficient: NonNegativeFloat
    entropy_coefficient: NonNegativeFloat
    return_decay: Fraction
    final_step_share: Fraction
    final_entropy_share: Fraction
    entropy_penalty: EntropyPenaltyConfig | None
    n_probe: PositiveInt

    @model_validator(mode="after")
    def _has_a_spread(self) -> "UpdateConfig":
        if self.n_worlds * self.n_steps < 2:
            raise ValueError("n_worlds 1 times n_steps 1 must be at least 2: one advantage has no spread")
        return self

    @property
    def n_samples(self) -> int:
        """Decisions of a minibatch, at most."""
        return min(self.minibatch_size, self.n_worlds * self.n_steps)

    def memory(self, layers: Layers, observed: Observed, n_agents: int) -> Iterator[Memory]:
        """Memory of an iteration, for a network of such layers and such observations.

        n_agents: vehicles of a world that the policy may drive
        """
        n_bytes = 2 * self.n_worlds * n_agents * self.n_steps * observed.n_bytes  # as collected, and as learnt from
        keys = ("algorithm.n_worlds", "algorithm.n_steps")
        sides = ("scenario.n_social", "scenario.n_followers") if n_agents > 1 else ()
        yield Memory("a rollout", n_bytes, (*keys, *sides, *observed.keys))
        n_bytes = self.n_samples * (observed.n_numbers + layers.n_outputs) * FLOAT_BYTES * N_COPIES
        seen = dict.fromkeys((*observed.keys, *layers.position_keys))
        yield Memory("a minibatch", n_bytes, ("algorithm.minibatch_size", *keys, *seen))

    def step_share(self, progress: float) -> float:
        """Length of the steps relative to the first ones, after the share `progress` of the training."""
        return 1 - (1 - self.final_step_share) * progress

    def entropy_weight(self, progress: float) -> float:
        """c_H after the share `progress` of the training."""
        if self.entropy_penalty is not None and progress >= self.entropy_penalty.start:
            return -self.entropy_penalty.coefficient
        return self.entropy_coefficient * (1 - (1 - self.final_entropy_share) * progress)


@dataclass(frozen=True)
class Decisions:
    """The decisions of an update, one row each; `[index]` picks a minibatch by its places among those of all ranks.

    observation: [N, *obs]
    action: [N] int64
    log_prob: [N] float32, of the action when it was taken
    advantage: [N] float32, normalised
    returns: [N] float32
    advice: [N, n_actions] float32, a teacher's probabilities, to imitate instead of the actions; None = no teacher
    share: this rank's, whose N rows these are; `len` counts those of all ranks
    """

    observation: Tensor
    action: Tensor
    log_prob: Tensor
    advantage: Tensor
    returns: Tensor
    advice: Tensor | None = None
    share: Share = WHOLE

    def __len__(self) -> int:
        return self.share.n_all(len(self.action))

    def __getitem__(self, index: Tensor) -> "Decisions":
        row, share = self.share.take(index)
        return Decisions.of([each.index_select(0, row) for each in self.columns], share)

    def __add__(self, more: "Decisions") -> "Decisions":
        pairs = zip(self.columns, more.columns, strict=True)
        return Decisions.of([torch.cat(pair) for pair in pairs], self.share.followed_by(more.share))

    @classmethod
    def of(cls, columns: Sequence[Tensor], share: Share) -> "Decisions":
        """Decisions of what `columns` holds."""
        observation, action, log_prob, advantage, returns, *advice = columns
        return cls(observation, action, log_prob, advantage, returns, advice[0] if advice else None, share)

    @property
    def columns(self) -> tuple[Tensor, ...]:
        """The fields with a row per decision, in their order."""
        columns = self.observation, self.action, self.log_prob, self.advantage, self.returns
        return columns if self.advice is None else (*columns, self.advice)

    def shared(self, share: Share) -> "Decisions":
        """The rows of a share in decisions that every rank knows."""
        return Decisions.of([share.own(each) for each in self.columns], share)


@dataclass(frozen=True)
class Outputs:
    """Outputs of the network for a minibatch: log_probs [N, A], value [N]."""

    log_probs: Tensor
    value: Tensor

    def log_prob(self, action: Tensor) -> Tensor:
        """log pi(a|s) of the actions [N], [N]."""
        return log_prob_of(action, self.log_probs)

    def first(self, n: int) -> "Outputs":
        """Outputs for the first n decisions, without a gradient."""
        return Outputs(self.log_probs[:n].detach(), self.value[:n].detach())


class Algorithm(Protocol):
    """The update of a policy from a minibatch, with its state beside the policy's weights."""

    @property
    def n_skipped(self) -> int:
        """Number of computations skipped so far because they were not finite."""
        ...

    def step(self, batch: Decisions, progress: float) -> dict[str, Tensor]:
        """Improve the policy with a minibatch, after the share `progress` of the training.

        Returns policy_loss, value_loss, entropy, kl and value_kl, and measures of the algorithm's own.
        """
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """State on which the next step depends, without the policy's weights and the generator."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        ...


def forward(policy: ActorCritic, observation: Tensor) -> Outputs:
    """Outputs of the network for observations [N, *obs]."""
    logits, value = policy(observation)
    return Outputs(logits.log_softmax(-1), value)


def policy_gradient_loss(outputs: Outputs, batch: Decisions) -> Tensor:
    """L_pi, whose gradient is the policy gradient (Eq. 5)."""
    return -batch.share.mean(batch.advantage * outputs.log_prob(batch.action))


def imitation_loss(outputs: Outputs, advice: Tensor, share: Share) -> Tensor:
    """KL divergence from a teacher's probabilities `advice` [N, n_actions]."""
    return share.mean((advice.xlogy(advice) - advice * outputs.log_probs).sum(-1))


def total_loss(
    policy_loss: Tensor,
    outputs: Outputs,
    batch: Decisions,
    policy: ActorCritic,
    config: UpdateConfig,
    progress: float,
) -> tuple[Tensor, dict[str, Tensor]]:
    """L, and its parts for the log: policy_loss, value_loss (half squared standard deviations), entropy (nat).

    All of them are this rank's parts of those of the whole minibatch.
    """
    value_loss = half_square(batch.returns - outputs.value, policy.value_std, batch.share)
    entropy = -batch.share.mean((outputs.log_probs.exp() * outputs.log_probs).sum(-1))
    loss = policy_loss - config.entropy_weight(progress) * entropy + config.value_coefficient * value_loss
    return loss, {
        "policy_loss": policy_loss.detach(),
        "value_loss": value_loss.detach(),
        "entropy": entropy.detach(),
    }


def differentiate(
    policy: ActorCritic,
    batch: Decisions,
    policy_loss: Callable[[Outputs, Decisions], Tensor],
    config: UpdateConfig,
    progress: float,
) -> tuple[Outputs, dict[str, Tensor]]:
    """Put grad L at the policy's parameters; returns the network's outputs for the minibatch, and the parts of L.

    policy_loss: L_pi of the algorithm, where no teacher says what to do
    Gradient and parts are those of the whole minibatch; collective.
    """
    outputs = forward(policy, batch.observation)
    advice, share = batch.advice, batch.share
    l_pi = policy_loss(outputs, batch) if advice is None else imitation_loss(outputs, advice, share)
    loss, parts = total_loss(l_pi, outputs, batch, policy, config, progress)
    policy.zero_grad(set_to_none=True)
    loss.backward()
    share.add_up([*(p.grad for p in policy.parameters() if p.grad is not None), *parts.values()])
    return outputs, parts


def first_seen(batch: Decisions, n: int) -> tuple[Tensor, Share]:
    """This rank's observations among the first `n` decisions of a minibatch, and its share in these."""
    return batch.observation[: batch.share.n_first(n)], batch.share.first(n)


def probe(batch: Decisions, outputs: Outputs, n: int) -> tuple[Tensor, Outputs, Share]:
    """What `measure_kl` asks for, of the first `n` decisions of a minibatch, before the step."""
    seen, share = first_seen(batch, n)
    return seen, outputs.first(len(seen)), share


@torch.no_grad()
def measure_kl(policy: ActorCritic, seen: Tensor, before: Outputs, share: Share = WHOLE) -> dict[str, Tensor]:
    """KL divergence between the network before and after a step, on the observations `seen` [n, *obs], nat; collective.

    kl: KL(old || new) of the actions
    value_kl: the same for unit Gaussians around the normalised values
    before: outputs of the network before the step
    share: this rank's in the observations
    """
    after = forward(policy, seen)
    measures = {
        "kl": share.mean((before.log_probs.exp() * (before.log_probs - after.log_probs)).sum(-1)),
        "value_kl": half_square(after.value - before.value, policy.value_std, share),
    }
    share.add_up([*measures.values()])
    return measures


def half_square(error: Tensor, std: Tensor, share: Share) -> Tensor:
    """This rank's part in the mean of 1/2 (error / std)^2."""
    return 0.5 * share.mean((error / std).square())


def minibatches(n: int, size: int, generator: Generator) -> Iterator[Tensor]:
    """A random partition of n decisions into minibatches of nearly equal size, `size` at most."""
    n_minibatches = -(-n // size)
    yield from torch.randperm(n, generator=generator, device=generator.device).chunk(n_minibatches)
