"""The config of a command line, composed of negopipe's own conf/ in any process, also inside another Hydra program."""

import copy
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_search_path_impl import ConfigSearchPathImpl
from hydra._internal.core_plugins.structured_config_source import StructuredConfigSource
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.types import RunMode
from hydra.version import VersionBase, setbase
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from negopipe import CONF
from negopipe.config.messages import explain_composition
from negopipe.config.root import RunConfig, load
from negopipe.errors import UserError

_alone = threading.Lock()
"""Lock on Hydra's version base."""


def load_config(*overrides: str) -> RunConfig:
    """The configuration of `python -m negopipe <overrides>`, checked and frozen.

    UserError names the key that is wrong, its value and what is allowed.
    """
    return compose_config(overrides)


def compose_config(overrides: Sequence[str] = ()) -> RunConfig:
    """The configuration of `python -m negopipe <overrides>`; UserError where that command would refuse them.

    Hydra composes one program's configs per process, and these may be the user's own. This loader works beside it: the
    state that Hydra holds for that program is neither used nor changed.
    """
    try:
        with _version_base("1.3"):
            composed = _loader().load_configuration("config", list(overrides), RunMode.RUN, from_shell=False)
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise UserError(explain_composition(error)) from error
    except ValueError as error:  # Hydra's check of the options of groups, which names none
        raise UserError(f"{error}, got {' '.join(overrides)}") from error
    return load(_without_hydra(composed))


def _loader() -> ConfigLoaderImpl:
    """Loader of conf/ and of Hydra's own configs. Schemas that the user's program has stored are left out: Hydra would
    apply one that is named like a config of negopipe."""
    Plugins.instance()  # Hydra's sources, and the configs that its plugins store
    places = ConfigSearchPathImpl()
    for provider, path in {"hydra": "pkg://hydra.conf", "main": str(CONF), "schema": "structured://"}.items():
        places.append(provider, path)
    loader = ConfigLoaderImpl(places)
    store = copy.copy(ConfigStore.instance())
    store.repo = {"hydra": store.repo["hydra"]}
    for source in loader.get_sources():
        if isinstance(source, StructuredConfigSource):
            source.store = store
    return loader


@contextmanager
def _version_base(version: str) -> Iterator[None]:
    """Context in which Hydra reads configs by the rules of a version. The version belongs to the process."""
    with _alone:
        base = VersionBase.instance()
        before = base.version_base
        setbase(version)
        try:
            yield
        finally:
            base.version_base = before


def _without_hydra(composed: DictConfig) -> DictConfig:
    with open_dict(composed):
        del composed["hydra"]
    return composed
