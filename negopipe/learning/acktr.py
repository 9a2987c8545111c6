"""ACKTR: actor-critic with a Kronecker-factored trust region (Wu et al. 2017).

One update on a minibatch of N decisions, with the network's parameters theta:

    loss              L = -1/N sum A_t log pi(a_t|s_t) + c_V L_V - c_H H
    momentum          m <- mu m + (1 - mu) grad L
    natural gradient  v = F_hat^-1 m
    trust region      eta = min(eta_max, sqrt(2 delta / v^T F_hat v)),  with v^T F_hat v = v^T m
    step              theta <- theta - eta v

Design decisions
    One backward pass. F is the Fisher matrix of both outputs (actions sampled from the policy; the normalised
    value a unit Gaussian), as Wu et al. propose for a shared encoder.
    Two trust regions. delta bounds the policy: the encoder's and the policy head's share of v^T F_hat v. The
    value head cannot move the policy and has a delta of its own, so its error, which is large at first, does
    not use up the budget of the policy.
    Momentum of gradients. It is taken before the preconditioning, so the step that is bounded is the step that is
    made. Where it points uphill, v^T grad L <= 0, it is dropped.
    Measured KL. F_hat leaves out the interaction of layers and underestimates the KL several times over. So the KL
    of the step is measured, and where it exceeds delta the step is shortened by sqrt(delta / KL). That of the value
    is measured too: otherwise value errors of the first updates can shrink the encoder's features to nothing.
"""

from collections.abc import Iterator
from typing import Literal

import torch
from torch import Generator, Tensor

from negopipe.checks import Memory, Observed
from negopipe.learning.kfac import Kfac, KfacConfig, add_to_layer, fisher_loss
from negopipe.learning.update import (
    Decisions,
    Outputs,
    UpdateConfig,
    differentiate,
    first_seen,
    measure_kl,
    policy_gradient_loss,
    probe,
)
from negopipe.policy.actor_critic import ActorCritic
from negopipe.policy.size import Layers
from negopipe.schema import Fraction, PositiveFloat, schema
from negopipe.tensors.prefixes import add_prefix, strip_prefix
from negopipe.tensors.share import Share


@schema
class NaturalGradientConfig(UpdateConfig):
    """Options of the algorithms that follow the natural gradient, beside those of all algorithms.

    kfac: quality and cost of the Fisher matrix
    """

    kfac: KfacConfig

    def memory(self, layers: Layers, observed: Observed, n_agents: int) -> Iterator[Memory]:
        yield from super().memory(layers, observed, n_agents)
        yield from self.kfac.memory(layers, self.n_samples)


@schema
class AcktrConfig(NaturalGradientConfig):
    """Options of ACKTR, beside those of all algorithms that follow the natural gradient.

    The first three are values at the start of training: where steps shrink to a share, deltas shrink to its square.

    learning_rate: eta_max
    kl_clip: delta of the policy, an upper bound of an update's KL(old || new), nat
    value_kl_clip: delta of the value, in half squared standard deviations of the return
    momentum: mu
    """

    kind: Literal["acktr"]
    learning_rate: PositiveFloat
    kl_clip: PositiveFloat
    value_kl_clip: PositiveFloat
    momentum: Fraction


class Acktr:
    """ACKTR for a policy; satisfies `negopipe.learning.update.Algorithm`.

    generator: samples the targets of the Fisher matrix; on the policy's device
    """

    def __init__(self, policy: ActorCritic, config: AcktrConfig, generator: Generator) -> None:
        self.policy, self.config, self.generator = policy, config, generator
        self.kfac = Kfac(policy, config.kfac)
        self.momentum: dict[str, Tensor] = {}
        self._n_unusable = 0

    @property
    def n_skipped(self) -> int:
        """Number of updates, statistics and inversions that were skipped."""
        return self._n_unusable + self.kfac.n_failures

    def step(self, batch: Decisions, progress: float) -> dict[str, Tensor]:
        """See `Algorithm.step`; policy_step and value_step (eta) are returned as well."""
        refresh(self.kfac, self.policy, batch, self.generator)
        outputs, parts = differentiate(self.policy, batch, policy_gradient_loss, self.config, progress)
        probed = probe(batch, outputs, self.config.n_probe)
        return {**parts, **self._descend(self.kfac.gradient(), self.config.step_share(progress), probed)}

    def state_dict(self) -> dict[str, Tensor]:
        state = add_prefix("kfac", self.kfac.state_dict()) | add_prefix("momentum", self.momentum)
        return state | {"n_unusable": torch.tensor(self._n_unusable)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        device = self.policy.value_mean.device
        self.kfac.load_state_dict(strip_prefix("kfac", state))
        self.momentum = {name: m.to(device) for name, m in strip_prefix("momentum", state).items()}
        self._n_unusable = int(state["n_unusable"])

    def _descend(
        self, gradient: dict[str, Tensor], shrink: float, probed: tuple[Tensor, Outputs, Share]
    ) -> dict[str, Tensor]:
        """Move the parameters within both trust regions; a gradient that is zero or not finite moves nothing.

        probed: what `measure_kl` asks for, from before the step
        """
        norm = inner(gradient, gradient)
        if not (self.kfac.is_ready and bool(norm.isfinite()) and bool(norm > 0)):
            self._n_unusable += 1
            return dict.fromkeys(("kl", "value_kl", "policy_step", "value_step"), torch.zeros_like(norm))
        self.momentum, v = self._direction(gradient)
        value_head = [name for name in v if name.startswith("value_head")]
        others = [name for name in v if not name.startswith("value_head")]
        bound, value_bound = (shrink**2 * clip for clip in (self.config.kl_clip, self.config.value_kl_clip))
        value_step = self._move(v, value_head, value_bound, shrink)
        policy_step = self._move(v, others, bound, shrink)
        moved = measure_kl(self.policy, *probed)
        value_share = kl_backtracking(moved["value_kl"], value_bound)
        policy_share = torch.minimum(kl_backtracking(moved["kl"], bound), value_share)
        if policy_share < 1:
            self._add(v, value_head, value_step * (1 - value_share))
            self._add(v, others, policy_step * (1 - policy_share))
            moved = measure_kl(self.policy, *probed)
        return {**moved, "policy_step": policy_step * policy_share, "value_step": value_step * value_share}

    def _move(self, v: dict[str, Tensor], names: list[str], bound: float, shrink: float) -> Tensor:
        """Step along -v in the layers `names`, within a trust region of their own; returns eta."""
        quadratic = inner({n: v[n] for n in names}, {n: self.momentum[n] for n in names})
        eta = trust_region_step(quadratic, bound, shrink * self.config.learning_rate)
        self._add(v, names, -eta)
        return eta

    def _add(self, v: dict[str, Tensor], names: list[str], eta: Tensor) -> None:
        for name in names:
            add_to_layer(self.kfac.layers[name], eta * v[name])

    def _direction(self, gradient: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The new momentum and its natural gradient, a descent direction."""
        mu = self.config.momentum
        momentum = {n: mu * self.momentum[n] + (1 - mu) * g if self.momentum else g for n, g in gradient.items()}
        v = self.kfac.natural_gradient(momentum)
        if bool(inner(v, gradient) > 0):
            return momentum, v
        return gradient, self.kfac.natural_gradient(gradient)


def refresh(kfac: Kfac, policy: ActorCritic, batch: Decisions, generator: Generator) -> None:
    """Let K-FAC take its statistics of a minibatch and invert, where its schedule says so; collective.

    generator: samples the targets of the Fisher matrix; on the policy's device
    """

    def loss(n: int) -> Tensor:
        seen, share = first_seen(batch, n)
        return fisher_loss(policy, seen, generator, share)

    kfac.refresh(loss, batch.share)


def trust_region_step(quadratic: Tensor, kl_clip: float, learning_rate: float) -> Tensor:
    """eta = min(eta_max, sqrt(2 delta / v^T F v)) for quadratic = v^T F v >= 0."""
    return (2 * kl_clip / quadratic.clamp(min=torch.finfo(torch.float32).tiny)).sqrt().clamp(max=learning_rate)


def kl_backtracking(kl: Tensor, kl_clip: float) -> Tensor:
    """Largest share of a step of measured `kl` within `kl_clip`, for a KL that is quadratic in the step; 0 if NaN."""
    return torch.where(kl.isfinite(), (kl_clip / kl.clamp(min=kl_clip)).sqrt(), 0.0)


def inner(a: dict[str, Tensor], b: dict[str, Tensor]) -> Tensor:
    """Inner product of two gradients, summed over the layers."""
    return torch.stack([(a[name] * b[name]).sum() for name in a]).sum()
