"""Demonstrations: the demonstration-augmented policy gradient (Rajeswaran et al. 2018, Eq. 5).

    L_pi = -1/(N + M) [ sum_{own} A_t log pi(a_t|s_t)  +  w sum_{demonstrated} log pi(a|s) ]
    w    = w_0 max(0, 1 - progress / until), linear where the original shrinks geometrically

There are N own decisions of the rollout, whose advantages A_t have a standard deviation of 1, and M demonstrated ones.
A demonstrated decision has the advantage w, w standard deviations better than expected, so every algorithm learns from
it as from the policy's own. Demonstrations do not train the value, which is that of the policy.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from pydantic import Field
from torch import Generator, Tensor

from negopipe.learning.update import Decisions, forward
from negopipe.policy.actor_critic import ActorCritic
from negopipe.schema import Fraction, PositiveFloat, PositiveInt, schema


@schema
class DemonstrationsConfig:
    """The demonstrations, found by a search with full knowledge (`negopipe.search.oracle`), and their weight.

    n_tasks: tasks of each family of the last stage, drawn as training draws them
    population, rounds: size of the search; as many rounds again remove switches without an effect, so that equal
        situations have equal demonstrations
    n_decisions: M, drawn anew in every iteration
    weight: w_0
    until: share of the training after which there are no demonstrations
    """

    n_tasks: PositiveInt
    population: PositiveInt
    rounds: PositiveInt
    n_decisions: PositiveInt
    weight: PositiveFloat
    until: Annotated[Fraction, Field(gt=0)]

    def weight_at(self, progress: float) -> float:
        """w after the share `progress` of the training."""
        return self.weight * max(0.0, 1 - progress / self.until)


@dataclass(frozen=True)
class Demonstrations:
    """D demonstrated decisions: observation [D, *obs], action [D] int64."""

    config: DemonstrationsConfig
    observation: Tensor
    action: Tensor

    @torch.no_grad()
    def show(self, policy: ActorCritic, progress: float, generator: Generator) -> Decisions | None:
        """M demonstrations as decisions to learn from; None where their weight is 0.

        generator: draws the demonstrations; on the policy's device
        """
        weight = self.config.weight_at(progress)
        if weight == 0:
            return None
        n, device = self.config.n_decisions, generator.device
        index = torch.randint(len(self.action), (n,), generator=generator, device=device)
        observation, action = self.observation[index], self.action[index]
        outputs = forward(policy, observation)
        advantage = torch.full((n,), weight, device=device)
        return Decisions(observation, action, outputs.log_prob(action), advantage, returns=outputs.value)
