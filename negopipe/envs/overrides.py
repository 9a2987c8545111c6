"""Overrides of the command line that an environment takes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from negopipe.agents.population import PopulationConfig
from negopipe.config.compose import compose_config
from negopipe.config.root import RunConfig
from negopipe.errors import UserError, abbreviate

KEYS = (
    *("scenario", "population", "perception", "dynamics", "planner", "safety", "observation", "reward"),
    *("policy.horizons_s", "evaluation.settings"),
)
"""Keys that an environment depends on."""
GROUPS = ("policy", "evaluation", "experiment")
"""Groups whose options set some of these keys, and others."""


def config_of(
    overrides: Sequence[str], preset: Sequence[str] = (), population: PopulationConfig | None = None
) -> RunConfig:
    """The configuration of an environment; UserError for an override that it does not depend on.

    Other keys may be given where the config would not be valid without them.
    preset: overrides of the environment's id, which come first
    population: takes the place of the config's; None = the config's, in which nobody is a policy that is not at hand
    """
    if isinstance(overrides, str) or not all(isinstance(override, str) for override in overrides):
        raise UserError(f"overrides must be a sequence of texts key=value, got {abbreviate(repr(overrides))}")
    given = [*preset, *overrides]
    if leading := _leading_setting(given):
        given.append(leading)
    config = compose_config(given)
    if population is not None:
        config = replace(config, population=population)
    for problem in () if population is not None else config.population.check_self("an environment"):
        raise UserError(f"{problem.key} must {problem.rule}, got {problem.value}")
    for index, override in enumerate(overrides, start=len(preset)):
        if not _is_acting(override) and _is_valid([*given[:index], *given[index + 1 :]]):
            allowed = f"of {', '.join(KEYS)} or options of {', '.join(GROUPS)}"
            raise UserError(f"overrides must be {allowed}, got {abbreviate(override)}")
    return config


def check_options(options: Mapping[str, Any] | None, *allowed: str) -> None:
    """UserError for an option of `reset` that is not allowed."""
    for key in options or {}:
        if key not in allowed:
            raise UserError(f"options must be {' or '.join(allowed)}, got the key {in_one_line(key)}")


def in_one_line(value: Any) -> str:
    """A short text of any value for a message."""
    return abbreviate(" ".join(repr(value).split()))


def _is_acting(override: str) -> bool:
    name = override.lstrip("+~").partition("=")[0].partition("@")[0]
    key = name.replace("/", ".")
    return name in GROUPS or any(f"{key}.".startswith(f"{place}.") for place in KEYS)


def _is_valid(overrides: Sequence[str]) -> bool:
    try:
        compose_config(overrides)
    except UserError:
        return False
    return True


def _leading_setting(overrides: Sequence[str]) -> str | None:
    """Override that makes the first of given settings the leading one, which an environment does not use."""
    names = [text.partition("=")[0] for text in overrides]
    settings = [text for text in overrides if text.startswith("evaluation.settings=")]
    if not settings or "evaluation.leading_setting" in names:
        return None
    first = settings[-1].partition("=")[2].strip("[]").split(",")[0].strip()
    return f"evaluation.leading_setting={first}" if first else None
