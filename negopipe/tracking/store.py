"""The MLflow store and one run's record in it: parameters, metrics, artifacts, checkpoints, status.

A run folder belongs to one process at a time (`<folder>/.lock`). The lock also tells who is alive: a record
that says RUNNING while nobody holds its folder was left by a dead process, and the next start closes it.
"""

import logging
import os
import re
import shutil
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import yaml
from filelock import FileLock, Timeout

from negopipe.errors import UserError
from negopipe.schema import PositiveFloat, PositiveInt, schema
from negopipe.tracking.database import artifact_location, connect, database_path, store_lock
from negopipe.tracking.metrics_file import merge_into
from negopipe.tracking.record import RunRecord, read_record, write_record

if TYPE_CHECKING:
    from mlflow import MlflowClient

log = logging.getLogger("negopipe")

METRICS_NAME = "metrics.json"
HISTORY_NAME = "history.csv"
SNAPSHOTS_NAME = "snapshots"
"""Folder of a run in which an unfinished training is kept."""
CONFIG_NAME = "config.yaml"

_HOST_TAG, _FOLDER_TAG, _PID_TAG = "host", "folder", "pid"
_PARAM_CHARACTERS = 6000
_PARAMS_PER_CALL = 100
_METRICS_PER_CALL = 1000


@schema
class TrackingConfig:
    """Where and how runs are recorded; `conf/tracking/mlflow.yaml` says what each value means."""

    uri: str | None
    experiment: str
    registered_model: str | None
    n_metrics_per_flush: PositiveInt
    flush_period_s: PositiveFloat
    snapshot_period_s: PositiveFloat
    n_snapshots: PositiveInt


class StoreConfig(Protocol):
    """What the store needs of the root config (`negopipe.config.RunConfig` has it)."""

    @property
    def name(self) -> str: ...
    @property
    def outputs(self) -> str: ...
    @property
    def tracking(self) -> TrackingConfig: ...


@contextmanager
def open_run(
    config: StoreConfig,
    run_name: str,
    resolved: dict[str, Any],
    source: str = "",
    takes_any_code: bool = False,
    is_fresh: bool = False,
) -> Iterator["TrackedRun"]:
    """A run folder `<outputs>/<name>/<run_name>`, held by this process, and its record in the store.

    resolved: the full config as plain mappings; it becomes the run's parameters and its config.yaml
    source: hash of the code; a run that other code has worked on is not gone on with
    takes_any_code: but for this, it is
    is_fresh: begin anew in any case

    The record ends as FINISHED, as FAILED on an exception, and as KILLED when the process is told to stop.
    Raises UserError if another process holds the folder or the store cannot be opened.
    """
    outputs = Path(config.outputs).absolute()
    folder = outputs / config.name / run_name
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock", blocking=False)
    try:
        with store_lock(outputs):  # folders change hands only here, so looking for dead runs disturbs nobody
            _hold(lock, folder)
            client = connect(outputs, config.tracking.uri)
            _close_dead_runs(client, own_folder=folder)
            accepted = None if takes_any_code else source
            record = None if is_fresh else _continued(read_record(folder), accepted)
            run = _reopen(client, config, folder, replace(record, source=source), accepted) if record else None
            run = run or _create_run(client, config, folder, source, accepted)
        with _final_status(run):
            run.log_config(resolved)
            yield run
    finally:
        lock.release()


def find_store(config: StoreConfig) -> "MlflowClient | None":
    """A client of the store, or None if no run has been recorded under `outputs` yet."""
    outputs, uri = Path(config.outputs), config.tracking.uri
    if uri is None and not database_path(outputs).exists():
        return None
    with store_lock(outputs):
        return connect(outputs, uri)


class TrackedRun:
    """One run: its folder and its record in the store.

    folder: absolute path, created
    run_id: MLflow's id
    accepted: hash of the code whose finished stages count; None = any
    is_continued: it was begun by an earlier process, whose entries in the store stay
    """

    def __init__(
        self,
        client: "MlflowClient",
        tracking: TrackingConfig,
        folder: Path,
        record: RunRecord,
        experiment_id: str,
        accepted: str | None = None,
        is_continued: bool = False,
    ) -> None:
        self.folder = folder
        self.run_id = record.run_id
        self.accepted = accepted
        self.is_continued = is_continued
        self._record = record
        self._last_step: dict[str, int] = {}
        self._client = client
        self._tracking = tracking
        self._experiment_id = experiment_id
        self._buffer: list[tuple[str, float, int, int]] = []
        self._flushed_at_s = time.monotonic()

    def log_config(self, resolved: dict[str, Any]) -> None:
        """The full config: a file in the folder, an artifact and, flattened, the run's parameters."""
        path = self.folder / CONFIG_NAME
        path.write_text(yaml.safe_dump(resolved, sort_keys=False, allow_unicode=True), encoding="utf-8")
        self.log_artifact(path)
        known = self._client.get_run(self.run_id).data.params if self.is_continued else {}
        self.log_params({key: value for key, value in flatten(resolved).items() if clean_name(key) not in known})

    def has_finished(self, stage: str, key: str) -> bool:
        """The stage has been run to its end in this folder, with the config that `key` is the hash of."""
        return self._record.has_finished(stage, key, self.accepted)

    def mark_finished(self, stage: str, key: str, source: str | None = None) -> None:
        """From now on the stage need not be run again; what it logged is in the store.

        source: hash of the code that made it, if not of this process
        """
        self.flush()
        self._record = self._record.with_finished(stage, key, source or self._record.source)
        write_record(self.folder, self._record)

    def log_params(self, params: Mapping[str, Any]) -> None:
        """Parameters that no one may change any more; long values are cut (config.yaml has them whole)."""
        from mlflow.entities import Param

        entries = [Param(clean_name(key), str(value)[:_PARAM_CHARACTERS]) for key, value in params.items()]
        for start in range(0, len(entries), _PARAMS_PER_CALL):
            self._client.log_batch(self.run_id, params=entries[start : start + _PARAMS_PER_CALL])

    def log_metrics(self, metrics: Mapping[str, float], step: int) -> None:
        """Scalars of one step; kept in memory and written in batches, in the order of the calls.

        What an earlier process of this run has written is not written twice.
        """
        now_ms = time.time_ns() // 1_000_000
        entries = [(clean_name(key), float(value), now_ms, step) for key, value in metrics.items()]
        self._buffer += [entry for entry in entries if step > self._step_before(entry[0])]
        is_late = time.monotonic() - self._flushed_at_s >= self._tracking.flush_period_s
        if is_late or len(self._buffer) >= self._tracking.n_metrics_per_flush:
            self.flush()

    def flush(self) -> None:
        """Write the buffered metrics."""
        from mlflow.entities import Metric

        entries, self._buffer = [Metric(*entry) for entry in self._buffer], []
        for start in range(0, len(entries), _METRICS_PER_CALL):
            self._client.log_batch(self.run_id, metrics=entries[start : start + _METRICS_PER_CALL])
        self._flushed_at_s = time.monotonic()

    def _step_before(self, key: str) -> int:
        """The last step of a metric that an earlier process of this run has written."""
        if not self.is_continued:
            return -1
        if key not in self._last_step:
            written = self._client.get_metric_history(self.run_id, key)
            self._last_step[key] = max((metric.step for metric in written), default=-1)
        return self._last_step[key]

    def log_artifact(self, path: Path, artifact_folder: str = "") -> None:
        """Copy a file, or a folder with all in it, to the run's artifacts."""
        log = self._client.log_artifacts if path.is_dir() else self._client.log_artifact
        log(self.run_id, str(path), artifact_folder or None)

    def log_checkpoint(self, path: Path, step: int, metrics: Mapping[str, float]) -> None:
        """Record a checkpoint as a model of this run, with the metrics that hold for it at that step.

        It becomes a version of `tracking.registered_model`, if that is set.
        """
        from mlflow.entities import LoggedModelOutput

        client = self._client
        if self.is_continued and self._has_checkpoint(step):
            return
        model = client.create_logged_model(
            self._experiment_id, f"step_{step}", source_run_id=self.run_id, params={"step": str(step)}
        )
        client.log_model_artifact(model.model_id, str(path))
        client.finalize_logged_model(model.model_id, "READY")
        client.log_outputs(self.run_id, [LoggedModelOutput(model.model_id, step)])
        for key, value in metrics.items():
            client.log_metric(self.run_id, clean_name(key), float(value), step=step, model_id=model.model_id)
        if self._tracking.registered_model is not None:
            self._register(self._tracking.registered_model, model.model_id)

    def _has_checkpoint(self, step: int) -> bool:
        outputs = self._client.get_run(self.run_id).outputs
        return outputs is not None and any(output.step == step for output in outputs.model_outputs)

    def update_metrics_json(self, section: Mapping[str, Any]) -> None:
        """Merge `section` into the folder's metrics.json.

        The file holds results, no clock times and no paths, so that two runs with one seed can be compared
        (durations are the exception; their keys say so).
        """
        merge_into(self.folder / METRICS_NAME, section)

    def set_description(self, markdown: str) -> None:
        """The text at the top of the run's page."""
        self.set_tags({"mlflow.note.content": markdown})

    def set_tags(self, tags: Mapping[str, str]) -> None:
        for key, value in tags.items():
            self._client.set_tag(self.run_id, clean_name(key), value)

    def close(self, status: str) -> None:
        """Write what is buffered, add metrics.json to the artifacts, and set the final status."""
        self.flush()
        if (self.folder / METRICS_NAME).exists():
            self.log_artifact(self.folder / METRICS_NAME)
        self._client.set_terminated(self.run_id, status)

    def _register(self, name: str, model_id: str) -> None:
        from mlflow.exceptions import MlflowException

        try:
            self._client.create_registered_model(name)
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise
        self._client.create_model_version(name, f"models:/{model_id}", run_id=self.run_id, model_id=model_id)


def clean_name(name: str) -> str:
    """A name that MLflow takes: no `= [ ] @ %`, no empty and no `..` path parts."""
    parts = re.sub(r"[^\w\-. :/]", "_", name).split("/")
    return "/".join(part for part in parts if part not in ("", ".", ".."))


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """`{"a": {"b": 1}}` as `{"a.b": 1}`; lists stay whole."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        is_branch = isinstance(value, Mapping) and value
        flat |= flatten(value, f"{prefix}{key}.") if is_branch else {f"{prefix}{key}": value}
    return flat


@contextmanager
def _final_status(run: TrackedRun) -> Iterator[None]:
    try:
        yield
    except Exception:
        run.close("FAILED")
        raise
    except BaseException:  # Ctrl-C, SIGTERM
        run.close("KILLED")
        raise
    run.close("FINISHED")


def _hold(lock: FileLock, folder: Path) -> None:
    try:
        lock.acquire()
    except Timeout as error:
        hint = "wait for it or change seed, name or outputs"
        raise UserError(f"the run folder {folder} is in use by another process: {hint}") from error


def _continued(record: RunRecord | None, accepted: str | None) -> RunRecord | None:
    """The record of a run to go on with, if there is one."""
    if record is not None and accepted not in (None, record.source):
        log.info("run        begins anew: other code made what is there (reuse=any_code takes it all the same)")
        return None
    return record


def _reopen(
    client: "MlflowClient", config: StoreConfig, folder: Path, record: RunRecord, accepted: str | None
) -> TrackedRun | None:
    """The run of a record, RUNNING again; None where the store has lost it."""
    from mlflow.exceptions import MlflowException

    try:
        info = client.get_run(record.run_id).info
    except MlflowException:
        return None
    client.update_run(record.run_id, status="RUNNING")
    for key, value in _process_tags(folder).items():
        client.set_tag(record.run_id, key, value)
    write_record(folder, record)
    return TrackedRun(client, config.tracking, folder, record, info.experiment_id, accepted, is_continued=True)


def _create_run(
    client: "MlflowClient", config: StoreConfig, folder: Path, source: str, accepted: str | None
) -> TrackedRun:
    name = config.tracking.experiment
    found = client.get_experiment_by_name(name)
    is_served = (config.tracking.uri or "").startswith(("http:", "https:"))  # and has a place of its own
    location = None if is_served else artifact_location(Path(config.outputs))
    experiment_id = found.experiment_id if found else client.create_experiment(name, location)
    run_id = client.create_run(experiment_id, tags=_process_tags(folder), run_name=folder.name).info.run_id
    shutil.rmtree(folder / SNAPSHOTS_NAME, ignore_errors=True)  # of a run that is not gone on with
    record = RunRecord(run_id, source)
    write_record(folder, record)
    return TrackedRun(client, config.tracking, folder, record, experiment_id, accepted)


def _process_tags(folder: Path) -> dict[str, str]:
    return {_HOST_TAG: socket.gethostname(), _PID_TAG: str(os.getpid()), _FOLDER_TAG: str(folder)}


def _close_dead_runs(client: "MlflowClient", own_folder: Path) -> None:
    """Mark as KILLED what says RUNNING on this host while no process holds its folder."""
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    is_ours = f"attributes.status = 'RUNNING' and tags.{_HOST_TAG} = '{socket.gethostname()}'"
    for record in client.search_runs(experiments, is_ours):
        folder = Path(record.data.tags[_FOLDER_TAG])
        if folder == own_folder or not _is_held(folder):
            client.set_terminated(record.info.run_id, "KILLED")


def _is_held(folder: Path) -> bool:
    if not folder.exists():
        return False
    try:
        with FileLock(folder / ".lock", blocking=False):
            return False
    except Timeout:
        return True
