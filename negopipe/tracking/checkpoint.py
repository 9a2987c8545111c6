"""Checkpoints: tensors and JSON in one safetensors file, so that loading one runs no code."""

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from negopipe.errors import UserError
from negopipe.tracking.database import first_line, unreachable
from negopipe.tracking.pretrained import find_pretrained
from negopipe.tracking.store import StoreConfig, find_store
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from mlflow import MlflowClient

CHECKPOINT_NAME = "checkpoint.safetensors"
"""File name of the checkpoint in a run folder."""

_METADATA_KEY = "negopipe"
_RUN_ID = re.compile(r"[0-9a-f]{32}")


def save_checkpoint(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write a checkpoint whole or not at all: a killed process leaves the earlier file.

    tensors: any shape, dtype and device; stored on the CPU
    metadata: JSON values (counters, the config, names)
    """
    on_cpu = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
    write_whole(path, save(on_cpu, {_METADATA_KEY: json.dumps(metadata)}))


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors (on the CPU) and metadata of a checkpoint; UserError if the file is missing, cut short or another's."""
    if not path.is_file():
        raise UserError(f"checkpoint must be a file, got {path}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            stored = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except SafetensorError as error:
        raise UserError(f"checkpoint must be a whole safetensors file, got {path}: {error}") from error
    if _METADATA_KEY not in stored:
        raise UserError(f"checkpoint must be a file that negopipe wrote, got {path}: it has no such metadata")
    return tensors, json.loads(stored[_METADATA_KEY])


def find_checkpoint(reference: str, config: StoreConfig) -> Path:
    """File of the checkpoint that `reference` names; UserError where there is none.

    reference: a path, a policy that comes with negopipe (`negopipe.tracking.pretrained`), or the id of an MLflow run,
        whose newest checkpoint it is
    """
    path = find_pretrained(reference, config.name) or Path(reference)
    if path.is_file():
        return path
    newest = _from_store(reference, config) if _RUN_ID.fullmatch(reference) else None
    if newest is None:
        allowed = "an existing file, pretrained, or the id of an MLflow run that saved one"
        raise UserError(f"checkpoint must be {allowed}, got {reference}")
    return newest


def _from_store(run_id: str, config: StoreConfig) -> Path | None:
    try:
        client = find_store(config)
        return _newest_checkpoint(client, run_id) if client else None
    except unreachable() as error:
        reached = "in a store that is in reach"
        raise UserError(f"checkpoint must be {reached}, got {run_id}: {first_line(error)}") from error


def _newest_checkpoint(client: "MlflowClient", run_id: str) -> Path | None:
    from mlflow.artifacts import download_artifacts

    models = client.search_logged_models(
        [experiment.experiment_id for experiment in client.search_experiments()],
        filter_string=f"source_run_id = '{run_id}'",
        order_by=[{"field_name": "creation_timestamp", "ascending": False}],
        max_results=1,
    )
    if not models:
        return None
    return Path(download_artifacts(artifact_uri=f"{models[0].artifact_location}/{CHECKPOINT_NAME}"))
