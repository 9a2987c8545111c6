"""YAML texts are parsed once per process: Hydra reads some forty files of conf/ for every config that it composes."""

import io
import pickle
from functools import cache
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from yaml import YAMLError

_load = OmegaConf.load


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


def read_once() -> None:
    OmegaConf.load = _load_once  # type: ignore[method-assign]
