"""Identity of results: hashes of the config that a stage depends on, and of the code."""

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import negopipe
from negopipe.config.root import RunConfig, as_mapping
from negopipe.tracking.checkpoint import find_checkpoint
from negopipe.tracking.pretrained import find_oracle

_GAME = (
    "seed",
    "device",
    "compile",
    "scenario",
    "population",
    "perception",
    "dynamics",
    "planner",
    "safety",
    "observation",
    "policy",
)
_TRAINING = (*_GAME, "reward", "algorithm", "curriculum")
DEPENDS_ON = {
    "preview": (*_GAME, "evaluation", "report"),
    "train": _TRAINING,
    "evaluate": (*_TRAINING, "evaluation"),
    "report": (*_TRAINING, "evaluation", "report"),
    "replay": (*_TRAINING, "evaluation", "report", "episode", "encounter"),
    "behaviour_map": (*_GAME, "evaluation", "behaviour_map", "report"),
    "cross_play": (*_TRAINING, "evaluation", "cross_play", "report"),
    "oracle": (*_GAME, "evaluation", "oracle"),
    "streets": (*_GAME, "report"),
    "benchmark": (*_TRAINING, "n_threads", "evaluation", "benchmark", "tracking"),
    "export": (*_TRAINING, "evaluation", "export"),
}
"""Groups of the config that a stage's result depends on, including those of the stages that it builds on."""

STARTS_FROM_CHECKPOINT = ("train", "evaluate", "report", "replay", "cross_play", "export")
"""Stages whose result also depends on `checkpoint`, the start of the training or, without training, the policy."""

NEED_THE_ORACLE = ("evaluate", "report", "replay")
"""Stages whose result also depends on the content of `evaluation.oracle`."""

MAPPED = "behaviour_map"
"""Stage whose figure the report shows."""
NOT_TRAINED_ON = ("families",)
"""Keys of the scenario that training does not depend on: it draws from the curriculum's families."""
WITHOUT_NETWORK = ("preview", "behaviour_map", "oracle", "streets")
"""Stages that build no network."""
ONLY_COMPUTED_WITH = ("precision",)
"""Keys of the policy that stages without a network do not depend on."""
ONLY_ROUNDED_BY = ("memory_format",)
"""Keys of the policy that only change the order of sums, as threads do. Another run of the same config may resolve them
otherwise by its timing, and its training is taken over all the same."""
ONLY_SHOWN = ("leading_setting",)
"""Keys of the evaluation that only change the order of the report and what the preview shows."""
SHOWS = ("preview", "report")
"""Stages that depend on them."""
ONLY_NAMES = ("experiment", "registered_model")
"""Keys of tracking that do not change its cost, which the benchmark measures."""


def stage_key(config: RunConfig, stage: str) -> str:
    """Hash of all that the result of `stage` depends on, with a checkpoint's content, in a config without `auto`."""
    values = as_mapping(config)
    relevant: dict[str, Any] = {group: values[group] for group in DEPENDS_ON[stage]}
    if stage == "train":
        relevant["scenario"] = _without(relevant["scenario"], NOT_TRAINED_ON)
    if stage != "benchmark":
        relevant["policy"] = _without(relevant["policy"], ONLY_ROUNDED_BY)
    if stage in WITHOUT_NETWORK:
        relevant["policy"] = _without(relevant["policy"], ONLY_COMPUTED_WITH)
    if stage not in SHOWS and "evaluation" in relevant:
        relevant["evaluation"] = _without(relevant["evaluation"], ONLY_SHOWN)
    if "tracking" in relevant:
        relevant["tracking"] = _without(relevant["tracking"], ONLY_NAMES)
    if stage == "report" and MAPPED in config.stages:
        relevant[MAPPED] = values[MAPPED]
    if stage in STARTS_FROM_CHECKPOINT and config.checkpoint is not None:
        start = _digest(find_checkpoint(config.checkpoint, config).read_bytes())
        relevant["checkpoint"] = [start, "train" in config.stages]
    if config.curriculum.teacher is not None and "curriculum" in DEPENDS_ON[stage]:
        teacher = find_checkpoint(config.curriculum.teacher.checkpoint, config)
        relevant["teacher"] = _digest(teacher.read_bytes())
    if config.encounter is not None and stage == "replay":
        path = Path(config.encounter)
        relevant["encounter"] = [config.encounter, _digest(path.read_bytes()) if path.is_file() else None]
    if config.evaluation.oracle is not None and stage in NEED_THE_ORACLE:
        path = find_oracle(config.evaluation.oracle)
        relevant["oracle.csv"] = _digest(path.read_bytes()) if path.is_file() else None
    return _digest(json.dumps(relevant, sort_keys=True).encode())


@cache
def source_hash() -> str:
    """Hash of the package's code, computed once per process, when all code is loaded."""
    package = Path(negopipe.__file__).parent
    total = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        total.update(f"{path.relative_to(package).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return total.hexdigest()[:16]


def _without(group: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    return {key: value for key, value in group.items() if key not in keys}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
