"""What composing a config repeats is done once per process: Hydra reads some forty files for every one, and merges
them although only values differ from an earlier config.
"""

import io
import pickle
from functools import cache
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.structured_config_source import StructuredConfigSource
from hydra.core.default_element import ResultDefault
from hydra.plugins.config_source import ConfigSource
from hydra.version import getbase
from omegaconf import DictConfig, ListConfig, OmegaConf
from yaml import YAMLError

from negopipe import CONF

SOURCES = {f"file://{CONF}", "pkg://hydra.conf", "structured://"}
"""Those of negopipe's own command line; their files do not change while tests run."""

_load = OmegaConf.load
_compose = ConfigLoaderImpl._compose_config_from_defaults_list
_composed: dict[tuple, bytes] = {}


def read_once() -> None:
    """In all tests of this process."""
    OmegaConf.load = _load_once  # type: ignore[method-assign]
    ConfigLoaderImpl._compose_config_from_defaults_list = _compose_once  # type: ignore[method-assign]


@cache
def _pickled(text: str) -> bytes:
    return pickle.dumps(_load(io.StringIO(text)))


def _load_once(file_: Any) -> DictConfig | ListConfig:
    """A new copy each time; an error in the text names the file, as OmegaConf's own does."""
    if not hasattr(file_, "read"):
        return _load(file_)
    text = file_.read()
    try:
        config: DictConfig | ListConfig = pickle.loads(_pickled(text))
    except YAMLError:
        file_.seek(0)
        return _load(file_)
    return config


def _compose_once(loader: ConfigLoaderImpl, defaults: list[ResultDefault], repo: Any) -> DictConfig:
    """A new copy each time of what the options `defaults` give together, before values are set."""
    sources: list[ConfigSource] = repo.get_sources()
    if not {source.full_path() for source in sources} <= SOURCES:
        return _compose(loader, defaults, repo)
    schemas = [sorted(source.store.repo) for source in sources if isinstance(source, StructuredConfigSource)]
    key = (str(getbase()), str(schemas), *(tuple(vars(option).items()) for option in defaults))
    if key not in _composed:
        _composed[key] = pickle.dumps(_compose(loader, defaults, repo))
    config: DictConfig = pickle.loads(_composed[key])
    return config
