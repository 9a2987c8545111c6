"""Callables that Hydra may take from a config: its plugins, and the handlers and formatters of logging.

Hydra makes objects of the callables that a YAML names: launchers and sweepers, which must be its plugins, callbacks and
the parts of its logging. It refuses callables that are known to run code, but not all of them (torch.load can unpickle
a file). negopipe has no callback and logs with the standard library.

The import alone installs the checks, and `negopipe.__main__` imports this: in a launcher's worker, Hydra sets up
logging before it calls any code of negopipe. Hydra has no public interface for this, so its version is pinned.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from hydra._internal import hydra as application
from hydra._internal import logging_config
from hydra._internal.callbacks import Callbacks
from omegaconf import DictConfig, OmegaConf

from negopipe.errors import UserError

LOGGING_CLASSES = ("logging.", "rich.logging.", "colorlog.")
STREAMS = ("ext://sys.stdout", "ext://sys.stderr")

_configure_logging = logging_config.configure_logging


class NoCallbacks(Callbacks):
    """Replacement of Hydra's callbacks; UserError for a config that has any."""

    def __init__(self, config: DictConfig | None = None) -> None:
        named = OmegaConf.select(config, "hydra.callbacks") if config is not None else None
        if named:
            raise UserError(f"hydra.callbacks must be empty, got {', '.join(map(str, named))}")
        super().__init__(None)


def configure_declared_logging(config: dict[str, Any]) -> None:
    """Replacement of Hydra's function; UserError for a part of logging that is no class of a logging library."""
    for key, value in _leaves(config):
        text = str(value)
        if key == "()" or (key == "class" and not text.startswith(LOGGING_CLASSES)):
            raise UserError(f"hydra logging must be made of classes of {', '.join(LOGGING_CLASSES)}, got {text}")
        if text.startswith(("ext://", "cfg://")) and text not in STREAMS:
            raise UserError(f"hydra logging must write to {' or '.join(STREAMS)}, got {text}")
    _configure_logging(config)


def _leaves(tree: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(tree, Mapping):
        for name, part in tree.items():
            yield from _leaves(part, str(name))
    elif isinstance(tree, list | tuple):
        for part in tree:
            yield from _leaves(part, key)
    else:
        yield key, tree


application.Callbacks = NoCallbacks  # type: ignore[misc]
logging_config.configure_logging = configure_declared_logging
