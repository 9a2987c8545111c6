"""ACKTR: actor-critic with a Kronecker-factored trust region (Wu et al. 2017).

One update on a minibatch of N decisions, with the network's parameters theta:

    loss  L = -1/N sum A_t log pi(a_t|s_t) - c_H H(pi) + c_V 1/(2N) sum (R_t - V(s_t))^2 / sigma^2
    momentum          m <- mu m + (1 - mu) grad L
    natural gradient  v = F_hat^-1 m
    trust region      eta = min(eta_max, sqrt(2 delta / v^T F_hat v)),  with v^T F_hat v = v^T m
    step              theta <- theta - eta v

Decisions
    One backward pass. F is the Fisher matrix of both outputs (actions sampled from the policy; the normalised
    value a unit Gaussian), as Wu et al. propose for a shared encoder.
    Two trust regions. delta bounds the policy: the encoder's and the policy head's share of v^T F_hat v. The
    value head cannot move the policy and has a delta of its own, so its error, which is large at first, does
    not use up the policy's budget.
    Momentum is taken over gradients, before the preconditioning, so that the step that is bounded is the step
    that is made. Where it points uphill, v^T grad L <= 0, it is dropped.
    F_hat knows nothing of how layers act together and underestimates the KL several times over. So the KL of
    the step is measured, and where it exceeds delta the step is shortened by sqrt(delta / KL). The value's is
    measured too: without that, value errors of the first updates can shrink the encoder's features to nothing.
    Scale. Returns are normalised by their running mean and spread sigma (the network's last layer is rescaled
    so that V does not change), advantages by the spread within the rollout.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from pydantic import model_validator
from torch import Generator, Tensor

from negopipe.learning.advantage import k_step_advantage
from negopipe.learning.kfac import Kfac, KfacConfig, add_to_layer, layer_gradient
from negopipe.learning.rollout import Rollout
from negopipe.nested import put_under, take_from
from negopipe.policy.actor_critic import ActorCritic, sample_action
from negopipe.schema import Fraction, NonNegativeFloat, PositiveFloat, PositiveInt, schema

STD_MIN = 1e-4
"""Smallest spread of returns and advantages that is divided by, in units of return."""


@schema
class AcktrConfig:
    """One iteration: how much is collected and how far the update may go.

    n_worlds, n_steps: E worlds take T decisions per iteration
    minibatch_size: about so many decisions per update, each decision is used once
    gamma: discount per decision
    n_return_steps: k of Eq. 6
    learning_rate: eta_max
    final_step_share: the steps shrink linearly with the progress of training, to this share at its end
    kl_clip: delta of the policy, an upper bound of an update's KL(old || new)
    value_kl_clip: the same for the value, in half squared standard deviations of the return
    momentum: mu
    value_coefficient, entropy_coefficient: c_V, c_H
    return_decay: weight of the old return statistics when a rollout comes in; smaller at the start
    kfac: quality and cost of the Fisher matrix
    """

    n_worlds: PositiveInt
    n_steps: PositiveInt
    minibatch_size: PositiveInt
    gamma: Fraction
    n_return_steps: PositiveInt
    learning_rate: PositiveFloat
    final_step_share: Fraction
    kl_clip: PositiveFloat
    value_kl_clip: PositiveFloat
    momentum: Fraction
    value_coefficient: NonNegativeFloat
    entropy_coefficient: NonNegativeFloat
    return_decay: Fraction
    kfac: KfacConfig

    @model_validator(mode="after")
    def _has_a_spread(self) -> "AcktrConfig":
        if self.n_worlds * self.n_steps < 2:
            raise ValueError("n_worlds 1 times n_steps 1 must be at least 2: one advantage has no spread")
        return self


@dataclass(frozen=True)
class Decisions:
    """What an update learns from, one row per decision; `[index]` picks a minibatch.

    observation: [N, *obs], action: [N] int64, advantage: [N] float32 (normalised), returns: [N] float32
    """

    observation: Tensor
    action: Tensor
    advantage: Tensor
    returns: Tensor

    def __len__(self) -> int:
        return len(self.action)

    def __getitem__(self, index: Tensor) -> "Decisions":
        return Decisions(*(getattr(self, field.name).index_select(0, index) for field in fields(self)))


class Acktr:
    """The learner: owns what an update needs beside the policy's weights, and changes those in place.

    generator: shuffles the minibatches and samples the Fisher matrix's actions; on the policy's device
    """

    def __init__(self, policy: ActorCritic, config: AcktrConfig, generator: Generator) -> None:
        self.policy = policy
        self.config = config
        self.generator = generator
        self.kfac = Kfac(policy, config.kfac)
        self.momentum: dict[str, Tensor] = {}
        self.return_moments = torch.zeros(2)
        self.n_rollouts = 0
        self.n_skipped = 0

    def update(self, rollout: Rollout, progress: float) -> dict[str, float]:
        """Improve the policy with one rollout.

        progress: share of the training that is done, 0 to 1; the steps shrink with it
        Returns the means over the minibatches: policy_loss, value_loss (half squared standard deviations),
        entropy (nat), kl and value_kl (measured KL(old || new) of policy and value, nat), policy_step and
        value_step (eta), explained_variance (of the returns by V before the update), and n_skipped, the
        updates, statistics and inversions skipped so far.
        """
        advantage, returns = k_step_advantage(rollout, self.config.gamma, self.config.n_return_steps)
        self._track_returns(returns)
        explained = 1 - (returns - rollout.value).var() / returns.var().clamp(min=STD_MIN**2)
        advantage = (advantage - advantage.mean()) / advantage.std().clamp(min=STD_MIN)
        decisions = Decisions(*(x.flatten(0, 1) for x in (rollout.observation, rollout.action, advantage, returns)))
        shrink = 1 - (1 - self.config.final_step_share) * progress
        metrics = [
            self._step(decisions[index], shrink)
            for index in minibatches(len(decisions), self.config.minibatch_size, self.generator)
        ]
        means = {name: float(torch.stack([m[name] for m in metrics]).mean()) for name in metrics[0]}
        n_skipped = float(self.n_skipped + self.kfac.n_failures)
        return {**means, "explained_variance": float(explained), "n_skipped": n_skipped}

    def state_dict(self) -> dict[str, Tensor]:
        """Everything but the policy's own weights that the next update depends on."""
        state = put_under("kfac", self.kfac.state_dict()) | put_under("momentum", self.momentum)
        state["counters"] = torch.tensor([self.n_rollouts, self.n_skipped])
        state["return_moments"] = self.return_moments
        state["generator"] = self.generator.get_state()
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on where `state_dict` was taken; the policy's weights are loaded apart."""
        device = self.policy.value_mean.device
        self.kfac.load_state_dict(take_from("kfac", state))
        self.momentum = {name: m.to(device) for name, m in take_from("momentum", state).items()}
        self.n_rollouts, self.n_skipped = state["counters"].tolist()
        self.return_moments = state["return_moments"].to(device)
        self.generator.set_state(state["generator"])

    def _step(self, batch: Decisions, shrink: float) -> dict[str, Tensor]:
        """One update with a minibatch."""
        probe = batch.observation[: self.config.kfac.n_statistics]
        self.kfac.refresh(lambda: fisher_loss(self.policy, probe, self.generator))
        logits, value = self.policy(batch.observation)
        log_prob = logits.log_softmax(-1)
        policy_loss = -(batch.advantage * log_prob.gather(1, batch.action[:, None]).squeeze(1)).mean()
        entropy = -(log_prob.exp() * log_prob).sum(-1).mean()
        value_loss = 0.5 * ((batch.returns - value) / self.policy.value_std).square().mean()
        loss = policy_loss - self.config.entropy_coefficient * entropy
        gradient = self._gradient(loss + self.config.value_coefficient * value_loss)
        return {
            "policy_loss": policy_loss.detach(),
            "value_loss": value_loss.detach(),
            "entropy": entropy.detach(),
            **self._descend(gradient, shrink, probe, (log_prob[: len(probe)].detach(), value[: len(probe)].detach())),
        }

    def _gradient(self, loss: Tensor) -> dict[str, Tensor]:
        self.policy.zero_grad(set_to_none=True)
        loss.backward()
        return {name: layer_gradient(layer) for name, layer in self.kfac.layers.items()}

    def _descend(
        self, gradient: dict[str, Tensor], shrink: float, probe: Tensor, old: tuple[Tensor, Tensor]
    ) -> dict[str, Tensor]:
        """Move the parameters within both trust regions; a gradient that is zero or not finite moves nothing.

        probe: observations [n, *obs] on which the KL is measured
        old: log-probabilities [n, A] and values [n] there, before the step
        """
        norm = inner(gradient, gradient)
        if not (self.kfac.is_ready and bool(norm.isfinite()) and bool(norm > 0)):
            self.n_skipped += 1
            return dict.fromkeys(("kl", "value_kl", "policy_step", "value_step"), torch.zeros_like(norm))
        self.momentum, v = self._direction(gradient)
        value_head = [name for name in v if name.startswith("value_head")]
        others = [name for name in v if not name.startswith("value_head")]
        value_step = self._move(v, value_head, self.config.value_kl_clip, shrink)
        policy_step = self._move(v, others, self.config.kl_clip, shrink)
        kl, value_kl = self._measure_kl(probe, old)
        value_share = shortening(value_kl, self.config.value_kl_clip)
        policy_share = torch.minimum(shortening(kl, self.config.kl_clip), value_share)
        if policy_share < 1:
            self._add(v, value_head, value_step * (1 - value_share))
            self._add(v, others, policy_step * (1 - policy_share))
            kl, value_kl = self._measure_kl(probe, old)
        return {
            "kl": kl,
            "value_kl": value_kl,
            "policy_step": policy_step * policy_share,
            "value_step": value_step * value_share,
        }

    def _move(self, v: dict[str, Tensor], names: list[str], kl_clip: float, shrink: float) -> Tensor:
        """Step along -v in some layers, within a trust region of their own; returns eta."""
        quadratic = inner({n: v[n] for n in names}, {n: self.momentum[n] for n in names})
        eta = shrink * trust_region_step(quadratic, kl_clip, self.config.learning_rate)
        self._add(v, names, -eta)
        return eta

    def _add(self, v: dict[str, Tensor], names: list[str], eta: Tensor) -> None:
        for name in names:
            add_to_layer(self.kfac.layers[name], eta * v[name])

    @torch.no_grad()
    def _measure_kl(self, observation: Tensor, old: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """KL(old || new) of the actions and of the unit Gaussians around the normalised values, nat."""
        logits, value = self.policy(observation)
        value_kl = 0.5 * ((value - old[1]) / self.policy.value_std).square().mean()
        return kl_divergence(old[0], logits.log_softmax(-1)), value_kl

    def _direction(self, gradient: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The new momentum and its natural gradient, a descent direction."""
        mu = self.config.momentum
        momentum = {n: mu * self.momentum[n] + (1 - mu) * g if self.momentum else g for n, g in gradient.items()}
        v = self.kfac.natural_gradient(momentum)
        if bool(inner(v, gradient) > 0):
            return momentum, v
        return gradient, self.kfac.natural_gradient(gradient)

    def _track_returns(self, returns: Tensor) -> None:
        """Move the value's normalisation towards the mean and spread of these returns."""
        decay = min(self.config.return_decay, 1 - 1 / (self.n_rollouts + 1))
        moments = torch.stack([returns.mean(), returns.square().mean()])
        self.return_moments = self.return_moments.to(moments).lerp(moments, 1 - decay)
        self.n_rollouts += 1
        mean, mean_square = self.return_moments
        std = (mean_square - mean.square()).clamp(min=STD_MIN**2).sqrt()
        self.policy.rescale_value(mean, std, keep_value=self.n_rollouts > 1)


def fisher_loss(policy: ActorCritic, observation: Tensor, generator: Generator) -> Tensor:
    """-sum log-likelihood of targets drawn from the network's own output, whose gradients make up F.

    Actions are drawn from pi; the normalised value is the mean of a unit Gaussian.
    """
    logits, value = policy(observation)
    action = sample_action(logits.detach(), generator)
    noise = torch.randn(value.shape, generator=generator, device=value.device)
    target = value.detach() + policy.value_std * noise
    log_likelihood = -0.5 * ((target - value) / policy.value_std).square()
    return -(log_likelihood + logits.log_softmax(-1).gather(1, action[:, None]).squeeze(1)).sum()


def trust_region_step(quadratic: Tensor, kl_clip: float, learning_rate: float) -> Tensor:
    """eta = min(eta_max, sqrt(2 delta / v^T F v)) for quadratic = v^T F v >= 0."""
    return (2 * kl_clip / quadratic.clamp(min=torch.finfo(torch.float32).tiny)).sqrt().clamp(max=learning_rate)


def shortening(kl: Tensor, kl_clip: float) -> Tensor:
    """The share of a step of measured `kl` that keeps to `kl_clip`, for a KL quadratic in the step; 0 if NaN."""
    return torch.where(kl.isfinite(), (kl_clip / kl.clamp(min=kl_clip)).sqrt(), 0.0)


def kl_divergence(old: Tensor, new: Tensor) -> Tensor:
    """Mean KL(old || new) in nat of policies with log-probabilities [N, A]."""
    return (old.exp() * (old - new)).sum(-1).mean()


def minibatches(n: int, size: int, generator: Generator) -> Iterator[Tensor]:
    """A random partition of n decisions into minibatches of nearly equal size, `size` at most."""
    n_minibatches = -(-n // size)
    yield from torch.randperm(n, generator=generator, device=generator.device).chunk(n_minibatches)


def inner(a: dict[str, Tensor], b: dict[str, Tensor]) -> Tensor:
    """Inner product of two gradients, summed over the layers."""
    return torch.stack([(a[name] * b[name]).sum() for name in a]).sum()
