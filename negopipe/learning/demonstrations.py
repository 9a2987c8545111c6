"""Learning from demonstrations beside one's own decisions: the demonstration-augmented policy gradient
(Rajeswaran et al. 2018, Eq. 5), with a weight that shrinks linearly instead of geometrically.

    L_pi = -1/(N + M) [ sum_{own} A_t log pi(a_t|s_t)  +  w sum_{shown} log pi(a|s) ]
    w    = w_0 max(0, 1 - progress / until)

N own decisions of the rollout, whose advantages A_t have a spread of 1, and M that are shown. So to show a decision
is to say that it was w spreads better than expected, and every algorithm learns from it as it does from its own. What
is shown leaves the value alone: it is that of the policy, not of who demonstrates.
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
    """What is demonstrated, found by a search that knows everything (`negopipe.search.oracle`), and how long.

    n_tasks: of each family of the last stage, drawn as training draws them
    population, rounds: of the search; as many rounds again take out switches that have no effect, so that decisions
        that are alike are shown alike
    n_decisions: M, drawn anew in every iteration
    weight: w_0
    until: share of the training after which nothing is shown any more
    """

    n_tasks: PositiveInt
    population: PositiveInt
    rounds: PositiveInt
    n_decisions: PositiveInt
    weight: PositiveFloat
    until: Annotated[Fraction, Field(gt=0)]

    def weight_at(self, progress: float) -> float:
        """w when the share `progress` of the training is done."""
        return self.weight * max(0.0, 1 - progress / self.until)


@dataclass(frozen=True)
class Demonstrations:
    """D decisions of somebody who knows how: observation [D, *obs], action [D] int64."""

    config: DemonstrationsConfig
    observation: Tensor
    action: Tensor

    @torch.no_grad()
    def show(self, policy: ActorCritic, progress: float, generator: Generator) -> Decisions | None:
        """M of them as decisions to learn from, None when their time is over.

        generator: draws them; on the policy's device
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
