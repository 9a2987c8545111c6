"""The drivers, one kind per file: planners that the policy is compared with, and drivers of social vehicles.

A new driver is a file here, whose `Config` is a `negopipe.agents.driver_config.DriverConfig` with a `kind` of its own,
and a YAML in `conf/evaluation/baseline` that chooses it as a baseline. A `HorizonRule` or a `MotionRule` can also drive
social vehicles; a YAML in `conf/population/driver` chooses it for them.
"""

from functools import reduce
from importlib import import_module
from operator import or_
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from negopipe.agents.driver_config import DriverConfig, HorizonRule, MotionRule

CONFIGS: tuple[type[DriverConfig], ...] = tuple(
    import_module(f"{__name__}.{module.name}").Config for module in iter_modules(__path__)
)
RULES = tuple(config for config in CONFIGS if issubclass(config, HorizonRule | MotionRule))
"""The kinds that can drive social vehicles: their decisions depend on what they perceive alone."""

if TYPE_CHECKING:
    BaselineConfig = DriverConfig
    RuleConfig = HorizonRule | MotionRule
else:
    BaselineConfig = Annotated[reduce(or_, CONFIGS), Field(discriminator="kind")]
    RuleConfig = reduce(or_, RULES)
