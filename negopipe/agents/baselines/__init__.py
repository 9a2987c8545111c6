"""The baselines, the planners that the policy is compared with, one per file.

A new baseline is a file here, whose `Config` is a `negopipe.agents.baseline.Baseline` with a `kind` of its own, and a
YAML in `conf/evaluation/baseline` that chooses it.
"""

from functools import reduce
from importlib import import_module
from operator import or_
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from negopipe.agents.baseline import Baseline

CONFIGS: tuple[type[Baseline], ...] = tuple(
    import_module(f"{__name__}.{module.name}").Config for module in iter_modules(__path__)
)

if TYPE_CHECKING:
    BaselineConfig = Baseline
else:
    BaselineConfig = Annotated[reduce(or_, CONFIGS), Field(discriminator="kind")]
