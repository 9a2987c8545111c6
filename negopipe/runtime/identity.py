"""Which results are the same: hashes of the config that a stage depends on, and of the code."""

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
    "observation",
    "policy",
)
_TRAINING = (*_GAME, "reward", "algorithm", "curriculum")
DEPENDS_ON = {
    "train": _TRAINING,
    "evaluate": (*_TRAINING, "evaluation"),
    "report": (*_TRAINING, "evaluation", "report"),
    "replay": (*_TRAINING, "evaluation", "report", "episode"),
    "behaviour_map": (*_GAME, "evaluation", "behaviour_map", "report"),
    "oracle": (*_GAME, "evaluation", "oracle"),
    "benchmark": (*_TRAINING, "n_threads", "evaluation", "benchmark", "tracking"),
}
"""Groups of the config that a stage's result depends on, those of the stages that it builds on included."""

STARTS_FROM_CHECKPOINT = ("train", "evaluate", "report", "replay")
"""... and of a checkpoint, if one is named: evaluated is what was trained from it or, without training, itself."""

NEED_THE_ORACLE = ("evaluate", "report", "replay")
"""Of an oracle.csv, if one is named, its content counts."""

MAPPED = "behaviour_map"
"""A stage whose figure the report shows where it ran before."""
NOT_TRAINED_ON = ("families",)
"""Of the scenario: training draws from the curriculum's families."""
WITHOUT_NETWORK = ("behaviour_map", "oracle")
ONLY_COMPUTED_WITH = ("precision",)
"""Of the policy: nothing to stages that build no network."""
ONLY_ROUNDED_BY = ("memory_format",)
"""Of the policy: it orders sums, as threads do. A run settles it by a timing, which may end otherwise in another run
of the same config; what that has trained is taken over all the same."""
ONLY_SHOWN = ("leading_setting",)
"""Of the evaluation: what comes first in the report."""
ONLY_NAMES = ("experiment", "registered_model")
"""Of tracking, whose cost the benchmark measures."""


def stage_key(config: RunConfig, stage: str) -> str:
    """Hash of all in a settled config that the result of `stage` depends on, a checkpoint's content included."""
    values = as_mapping(config)
    relevant: dict[str, Any] = {group: values[group] for group in DEPENDS_ON[stage]}
    if stage == "train":
        relevant["scenario"] = _without(relevant["scenario"], NOT_TRAINED_ON)
    if stage != "benchmark":
        relevant["policy"] = _without(relevant["policy"], ONLY_ROUNDED_BY)
    if stage in WITHOUT_NETWORK:
        relevant["policy"] = _without(relevant["policy"], ONLY_COMPUTED_WITH)
    if stage != "report" and "evaluation" in relevant:
        relevant["evaluation"] = _without(relevant["evaluation"], ONLY_SHOWN)
    if "tracking" in relevant:
        relevant["tracking"] = _without(relevant["tracking"], ONLY_NAMES)
    if stage == "report" and MAPPED in config.stages:
        relevant[MAPPED] = values[MAPPED]
    if stage in STARTS_FROM_CHECKPOINT and config.checkpoint is not None:
        start = _digest(find_checkpoint(config.checkpoint, config).read_bytes())
        relevant["checkpoint"] = [start, "train" in config.stages]
    if config.evaluation.oracle is not None and stage in NEED_THE_ORACLE:
        path = find_oracle(config.evaluation.oracle)
        relevant["oracle.csv"] = _digest(path.read_bytes()) if path.is_file() else None
    return _digest(json.dumps(relevant, sort_keys=True).encode())


@cache
def source_hash() -> str:
    """Hash of the package's code as it is now; taken once per process, whose code does not change any more."""
    package = Path(negopipe.__file__).parent
    total = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        total.update(f"{path.relative_to(package).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return total.hexdigest()[:16]


def _without(group: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    return {key: value for key, value in group.items() if key not in keys}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
