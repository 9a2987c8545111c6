"""Configs of many overrides: Hydra composes the options of each group once, values are set in a copy of that."""

import pickle
from collections.abc import Sequence
from functools import cache

from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from negopipe import CONF
from negopipe.config.messages import explain_composition
from negopipe.config.root import RunConfig, load
from negopipe.errors import UserError

FEW_STREETS = ("scenario.streets.n_training=2", "scenario.streets.n_held_out=2")
"""For configs that draw streets: drawing hundreds takes seconds."""


@cache
def composed(options: tuple[str, ...]) -> DictConfig:
    """As the command line composes it."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", [*options])


@cache
def pickled(options: tuple[str, ...]) -> bytes:
    """A copy of a config is made from this six times faster than by deepcopy."""
    return pickle.dumps(composed(options))


def applied(options: tuple[str, ...], values: Sequence[str]) -> DictConfig:
    """What `composed((*options, *values))` gives, twenty times faster; `values` are keys, not options of groups."""
    config: DictConfig = pickle.loads(pickled(options))
    parsed = OverridesParser.create().parse_overrides([*values])
    ConfigLoaderImpl.validate_sweep_overrides_legal(parsed, RunMode.RUN, from_shell=True)
    ConfigLoaderImpl._apply_overrides_to_config(parsed, config)
    return config


def is_group(key: str) -> bool:
    return "/" in key or (CONF / key).is_dir()


def compose_config(overrides: Sequence[str] = ()) -> RunConfig:
    """What negopipe's own gives or refuses, faster where only values differ from an earlier call."""
    options = tuple(text for text in overrides if is_group(text.lstrip("+").partition("=")[0]))
    try:
        config = applied(options, [text for text in overrides if text not in options])
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise UserError(explain_composition(error)) from error
    return load(config)
