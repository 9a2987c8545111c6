"""Learning from a teacher: the policy drives, and a trained policy says what it would do there (Ross et al. 2011).

For the first share of a training every decision is one to imitate. The policy drives by its own actions, so that it is
taught in the states that it gets into, but it learns from the teacher's probabilities q (Rusu et al. 2016, "Policy
distillation"):

    L_pi = 1/N sum_t sum_a q(a|s_t) log[q(a|s_t) / pi(a|s_t)]

The value learns from the policy's own returns. Then the policy learns from its own actions alone, from a value that
fits them.
"""

from collections.abc import Callable
from typing import Annotated

from pydantic import Field
from torch import Tensor

from negopipe.schema import Fraction, PathText, schema

Advice = Callable[[], Tensor]
"""What the teacher would do now: probabilities [A, n_actions], without meaning for agents that others drive."""


@schema
class TeacherConfig:
    """A teacher.

    checkpoint: trained policy with the horizons of the config's; its network and its observation may be others
    until: share of the training after which the policy learns from its own actions
    """

    checkpoint: PathText
    until: Annotated[Fraction, Field(gt=0)]
