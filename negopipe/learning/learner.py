"""The learner: updates of the policy from a rollout, by the algorithm of the config.

Returns are normalised by their running mean and standard deviation sigma; the network's last layer is rescaled so that
V does not change. Advantages are normalised by their standard deviation in the rollout. No algorithm depends on the
scale of the rewards.
"""

from typing import Annotated

import torch
from pydantic import Field
from torch import Generator, Tensor

from negopipe.learning.a2c import A2cConfig, a2c
from negopipe.learning.acktr import Acktr, AcktrConfig
from negopipe.learning.acktr_adam import AcktrAdam, AcktrAdamConfig
from negopipe.learning.advantage import estimate_advantage
from negopipe.learning.demonstrations import Demonstrations
from negopipe.learning.ppo import PpoConfig, ppo
from negopipe.learning.rollout import Rollout
from negopipe.learning.update import Algorithm, Decisions, minibatches
from negopipe.policy.actor_critic import ActorCritic
from negopipe.tensors.prefixes import add_prefix, strip_prefix

AnyAlgorithmConfig = AcktrConfig | AcktrAdamConfig | A2cConfig | PpoConfig
AlgorithmConfig = Annotated[AnyAlgorithmConfig, Field(discriminator="kind")]

STD_MIN = 1e-4
"""Smallest standard deviation of returns and advantages that is divided by, in units of return."""


def build_algorithm(policy: ActorCritic, config: AnyAlgorithmConfig, generator: Generator) -> Algorithm:
    """The algorithm of a config."""
    match config:
        case AcktrConfig():
            return Acktr(policy, config, generator)
        case AcktrAdamConfig():
            return AcktrAdam(policy, config, generator)
        case A2cConfig():
            return a2c(policy, config)
        case PpoConfig():
            return ppo(policy, config)


class Learner:
    """The state of learning beside the policy's weights, which it changes in place.

    generator: shuffles the minibatches, samples the targets of the Fisher matrix and the demonstrations; on the
        policy's device
    demonstrations: decisions to learn from beside the policy's own
    """

    def __init__(
        self,
        policy: ActorCritic,
        config: AnyAlgorithmConfig,
        generator: Generator,
        demonstrations: Demonstrations | None = None,
    ) -> None:
        self.policy, self.config, self.generator, self.demonstrations = policy, config, generator, demonstrations
        self.algorithm = build_algorithm(policy, config, generator)
        self.return_moments = torch.zeros(2)
        self.n_rollouts = 0

    def update(self, rollout: Rollout, progress: float) -> dict[str, float]:
        """Improve the policy with one rollout; collective.

        progress: share of the training that is done, 0 to 1; the steps and the weight of the entropy shrink with it
        Returns the means over the updates of what `Algorithm.step` returns, explained_variance (of the returns by
        V before the update), and n_skipped, the number of computations skipped so far because they were not finite.
        """
        config = self.config
        advantage, returns = estimate_advantage(rollout, config.gamma, config.advantage)
        given = (rollout.action, rollout.log_prob, advantage, returns, rollout.value)
        action, log_prob, advantage, returns, value = (_learned_from(f, rollout.is_learning) for f in given)
        self._track_returns(returns)
        explained = 1 - (returns - value).var() / returns.var().clamp(min=STD_MIN**2)
        advantage = (advantage - advantage.mean()) / advantage.std().clamp(min=STD_MIN)
        is_own = rollout.share.own(rollout.is_learning, 1)
        seen, *advice = (_learned_from(f, is_own) for f in (rollout.observation, rollout.advice) if f is not None)
        share = rollout.share.chosen(rollout.is_learning)
        known = (share.own(f) for f in (action, log_prob, advantage, returns))
        decisions = Decisions.of([seen, *known, *advice], share)
        demonstrated = (
            None if self.demonstrations is None else self.demonstrations.show(self.policy, progress, self.generator)
        )
        if demonstrated is not None:
            decisions = decisions + demonstrated.shared(share.slice_of(len(demonstrated)))
        metrics = [
            self.algorithm.step(decisions[index], progress)
            for _ in range(config.n_epochs)
            for index in minibatches(len(decisions), config.minibatch_size, self.generator)
        ]
        means = {name: float(torch.stack([m[name] for m in metrics]).mean()) for name in metrics[0]}
        return {**means, "explained_variance": float(explained), "n_skipped": float(self.algorithm.n_skipped)}

    def state_dict(self) -> dict[str, Tensor]:
        """State on which the next update depends, without the policy's weights."""
        state = add_prefix("algorithm", self.algorithm.state_dict())
        state["n_rollouts"] = torch.tensor(self.n_rollouts)
        state["return_moments"] = self.return_moments
        state["generator"] = self.generator.get_state()
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned; the policy's weights are loaded separately."""
        self.algorithm.load_state_dict(strip_prefix("algorithm", state))
        self.n_rollouts = int(state["n_rollouts"])
        self.return_moments = state["return_moments"].to(self.policy.value_mean.device)
        self.generator.set_state(state["generator"])

    def _track_returns(self, returns: Tensor) -> None:
        """Move the normalisation of the value towards the mean and standard deviation of these returns."""
        decay = min(self.config.return_decay, 1 - 1 / (self.n_rollouts + 1))
        moments = torch.stack([returns.mean(), returns.square().mean()])
        self.return_moments = self.return_moments.to(moments).lerp(moments, 1 - decay)
        self.n_rollouts += 1
        mean, mean_square = self.return_moments
        std = (mean_square - mean.square()).clamp(min=STD_MIN**2).sqrt()
        self.policy.rescale_value(mean, std, keep_value=self.n_rollouts > 1)


def _learned_from(field: Tensor, is_learning: Tensor) -> Tensor:
    """[N, ...]: the rows of a field [T, A, ...] of the decisions to learn from."""
    return field.flatten(0, 1) if is_learning.all() else field[is_learning]
