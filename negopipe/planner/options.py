"""Options of conf/scenario and conf/planner by their names, read without Hydra, for programs that only plan."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf
from pydantic import TypeAdapter, ValidationError

from negopipe import CONF
from negopipe.errors import UserError
from negopipe.planner.config import PlannerConfig
from negopipe.simulation.scenario import ScenarioConfig

T = TypeVar("T")


def scenario_option(name: str, changes: Mapping[str, Any] | None = None) -> ScenarioConfig:
    """The scenario conf/scenario/<name>.yaml; `changes` are values by key, as `{"road": {"corridor_gap_m": 3.4}}`.

    UserError names an option or a key that does not exist, and a value that is not allowed.
    """
    return _checked("scenario", name, changes, ScenarioConfig)


def planner_option(name: str, changes: Mapping[str, Any] | None = None) -> PlannerConfig:
    """The planner conf/planner/<name>.yaml, likewise."""
    return _checked("planner", name, changes, PlannerConfig)


def _checked(group: str, name: str, changes: Mapping[str, Any] | None, kind: type[T]) -> T:
    values = OmegaConf.to_container(OmegaConf.merge(_composed(CONF / group, name), changes or {}))
    try:
        return TypeAdapter(kind).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, (group, *first["loc"])))
        raise UserError(f"{key}: {first['msg']}, got {first['input']!r}") from error


def _composed(folder: Path, name: str) -> dict[str, Any]:
    """Values of an option: those of its `defaults` list, and its own where the list says `_self_`."""
    path = folder / f"{name}.yaml"
    if not path.is_file():
        allowed = ", ".join(sorted(each.stem for each in folder.glob("*.yaml")))
        raise UserError(f"{folder.name} must be one of {allowed}, got {name}")
    own: dict[str, Any] = OmegaConf.to_container(OmegaConf.load(path))  # type: ignore[assignment]
    parts: list[dict[str, Any]] = []
    for entry in own.pop("defaults", ["_self_"]):
        if entry == "_self_":
            parts.append(own)
        elif isinstance(entry, str):
            parts.append(_composed(folder, entry))
        else:
            parts += [{key: _composed(folder / key, option)} for key, option in entry.items() if option]
    return OmegaConf.to_container(OmegaConf.merge(*parts))  # type: ignore[return-value]
