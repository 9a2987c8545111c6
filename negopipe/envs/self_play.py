"""The config of environments in which the actions drive every vehicle."""

from collections.abc import Sequence

from negopipe.agents.population import PopulationConfig, SelfDriver, SocialDriverConfig
from negopipe.config.root import RunConfig
from negopipe.envs.overrides import config_of
from negopipe.errors import UserError

EVERYONE = PopulationConfig(
    drivers={"agent": SocialDriverConfig(weight=1.0, driver=SelfDriver(kind="self", action="sample"))}
)
"""The population whose only driver is whoever gives the actions."""


def self_play_config(overrides: Sequence[str], preset: Sequence[str] = ()) -> RunConfig:
    """The config of `config_of` with `EVERYONE`; UserError for an override of the population."""
    config = config_of(overrides, preset, EVERYONE)
    for override in overrides:
        if override.lstrip("+~").startswith("population"):
            raise UserError(f"overrides must not change the population, which the actions drive, got {override}")
    return config
