"""One run, from its beginning to its end, and its entries in the store.

Every entry goes to the run's journal first and from there to the store, so that a store out of reach stops no run and
misses no entry.
"""

import logging
import os
import shlex
import time
import uuid
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pandas as pd
import yaml

from negopipe.schema import INFINITE, Address, Label, PositiveFloat, PositiveInt, schema
from negopipe.tracking.dashboard import chart_address
from negopipe.tracking.database import (
    connect,
    database_path,
    first_line,
    follow_move,
    sqlite_file,
    store_lock,
    unreachable,
)
from negopipe.tracking.metrics_file import merge_into
from negopipe.tracking.names import clean_name, cleaned, flatten
from negopipe.tracking.record import OVERRIDES, RunRecord, as_command, read_record, write_record
from negopipe.tracking.run_folder import (
    CHECKPOINTS_NAME,
    CONFIG_NAME,
    METRICS_NAME,
    TABLES_NAME,
    archive,
    link_or_copy,
    lock,
)
from negopipe.tracking.sync.dead_runs import close_dead_runs, lock_id, process_tags
from negopipe.tracking.sync.delivery import Delivery
from negopipe.tracking.sync.journal import Journal
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from mlflow import MlflowClient

log = logging.getLogger("negopipe")

_PARAM_CHARACTERS = 6000
"""Longest value of a parameter that MLflow accepts."""
_PAUSE_PER_TRY = 20
"""Pause before a store out of reach is tried again, in durations of the last try: waiting for an answer costs a
training 5 % of its time at most."""


@schema
class TrackingConfig:
    """Options of the store; `conf/tracking/mlflow.yaml` explains them."""

    uri: Address | None
    experiment: Label
    registered_model: Label | None
    n_metrics_per_flush: PositiveInt
    flush_period_s: PositiveFloat
    snapshot_period_s: PositiveFloat
    n_snapshots: PositiveInt


class StoreConfig(Protocol):
    """Part of the root config (`negopipe.config.root.RunConfig`) that the store needs."""

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
    tags: Mapping[str, str] | None = None,
    source: str = "",
    takes_any_code: bool = False,
    is_fresh: bool = False,
) -> Iterator["TrackedRun"]:
    """Context with the run of a folder `<outputs>/<name>/<run_name>`, locked by this process.

    resolved: the full config as plain mappings; it becomes the run's parameters and its config.yaml
    tags: further tags of the run in the store
    source: hash of the code; a run of other code is not resumed
    takes_any_code: it is resumed all the same
    is_fresh: no run is resumed

    The store knows the run from `TrackedRun.begin` on. It ends as FINISHED, as FAILED on an exception and as KILLED on
    Ctrl-C or SIGTERM. A run that is not resumed is kept as `<run_name>.old1` and so on. Raises UserError if another
    process holds the folder and, before anything is created, where no such store is possible.
    """
    outputs, uri = Path(config.outputs).absolute(), config.tracking.uri
    folder = outputs / config.name / run_name
    accepted = None if takes_any_code else source
    sqlite_file(outputs, uri)
    with store_lock(outputs):  # run folders are locked only under this lock, so the search for dead runs is safe
        follow_move(outputs, uri)
        held = lock(folder)
        record = None if is_fresh else _continued(read_record(folder), accepted)
        if record is None and archive(folder, held):
            held = lock(folder)
    try:
        if record is None:
            record = RunRecord(uuid.uuid4().hex, source)
            write_record(folder, record)
        record, overrides = replace(record.with_tags(tags or {}), source=source), (tags or {}).get(OVERRIDES)
        run = TrackedRun(config, folder, record, resolved, accepted, overrides)
        with _final_status(run):
            yield run
    finally:
        held.release()


def find_store(config: StoreConfig) -> "MlflowClient | None":
    """Client of the store; None if no run has been recorded under `outputs` yet."""
    outputs, uri = Path(config.outputs), config.tracking.uri
    if uri is None and not database_path(outputs).exists():
        return None
    sqlite_file(outputs, uri)
    with store_lock(outputs):
        follow_move(outputs, uri)
        return connect(outputs, uri)


class TrackedRun:
    """One run: its folder and its entries in the store.

    folder: absolute path, created
    accepted: hash of the code whose finished stages count; None = any
    overrides: overrides of this process's command; None = not known
    has_begun: whether this process has made entries for the store
    """

    def __init__(
        self,
        config: StoreConfig,
        folder: Path,
        record: RunRecord,
        resolved: dict[str, Any],
        accepted: str | None,
        overrides: str | None = None,
    ) -> None:
        self.folder, self.accepted, self.overrides = folder, accepted, overrides
        self._tracking, self._record, self._resolved = config.tracking, record, resolved
        self._outputs = Path(config.outputs).absolute()
        self._journal = Journal(folder)
        self._delivery = Delivery(folder, self._journal, self._outputs, config.tracking.uri)
        self._last_step, self._logged = _earlier_metrics(self._journal)
        self._client: MlflowClient | None = None
        self.has_begun = self._is_out_of_reach = False
        self._n_waiting = 0
        self._sent_s, self._next_try_s = time.monotonic(), 0.0

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the run; None until the store knows the run."""
        return self._delivery.done.run_id

    @property
    def charts(self) -> str | None:
        """Address of the charts of this run and of its experiment; None until the store knows the run."""
        experiment_id = self._delivery.done.experiment_id
        has_view = any(entry["kind"] == "view" for _, entry in self._journal.after(0))
        return chart_address(experiment_id, self._tracking.uri, has_view=has_view) if experiment_id else None

    @property
    def commands(self) -> list[str]:
        """Commands that made the files of the folder, to paste: those of the results, then that of this process."""
        own = [] if self.overrides is None else [self.overrides]
        return [as_command(overrides) for overrides in dict.fromkeys([*self._record.commands(), *own])]

    def begin(self) -> None:
        """Make the run RUNNING in the store. UserError where no such store is possible or the store is damaged."""
        if self.has_begun:
            return
        try:
            self._connect()
        except OSError as error:
            self._say_out_of_reach(error)
        write_record(self.folder, self._record)
        tags = {**self._record.tags, **process_tags(self.folder)}
        experiment, key = self._tracking.experiment, self._record.key
        about: dict[str, Any] = {"run_name": self.folder.name, "key": key, "tags": cleaned(tags)}
        about |= {"store": self._delivery.store, "lock": lock_id(self.folder)}  # for the search for dead runs
        self._journal.append("begin", None, experiment=experiment, **about)
        self.has_begun = True
        self._log_config()
        self.deliver()

    def _log_config(self) -> None:
        """Log the full config: a file in the folder, an artifact and, flattened, the run's parameters."""
        text = yaml.safe_dump(self._resolved, sort_keys=False, allow_unicode=True)
        write_whole(self.folder / CONFIG_NAME, text.encode())
        params = cleaned({key: str(value)[:_PARAM_CHARACTERS] for key, value in flatten(self._resolved).items()})
        self._journal.append("artifact", path=CONFIG_NAME, folder="")
        self._journal.append("params", values=params)

    def has_finished(self, stage: str, key: str) -> bool:
        """Whether the stage was finished in this folder, with the config of hash `key`."""
        return self._record.has_finished(stage, key, self.accepted)

    def mark_finished(self, stage: str, key: str, source: str | None = None) -> None:
        """Record that the stage is finished and need not run again.

        source: hash of the code that made it, if not this process's code
        """
        self.sync()
        before = self._record.tags
        self._record = self._record.with_finished(stage, key, source or self._record.source, self.overrides)
        write_record(self.folder, self._record)
        if self._record.tags != before:
            self.set_tags(self._record.tags)

    def log_metrics(self, metrics: Mapping[str, float], step: int) -> None:
        """Log scalars of one step; they are sent in batches, in the order of the calls.

        Values that an earlier process of this run has logged are not logged again.
        """
        values = cleaned({key: float(value) for key, value in metrics.items()})
        new = {key: value for key, value in values.items() if step > self._last_step.get(key, -1)}
        if new:
            self._logged = (step, self._tell("metrics", step=step, values=new))
        self._n_waiting += len(new)
        is_late = time.monotonic() - self._sent_s >= self._tracking.flush_period_s
        if is_late or self._n_waiting >= self._tracking.n_metrics_per_flush:
            self.deliver()

    def log_artifact(self, path: Path, artifact_folder: str = "") -> None:
        """Copy a file, or a folder with its content, to the store."""
        self._tell("artifact", path=os.path.relpath(path, self.folder), folder=artifact_folder)
        self.deliver()

    def log_image(self, path: Path, key: str, step: int) -> None:
        """Show a picture of the run folder among the charts; those of one key share a chart with a slider of steps."""
        self._tell("image", path=os.path.relpath(path, self.folder), key=key, step=step)
        self.deliver()

    def log_table(self, name: str, table: pd.DataFrame) -> None:
        """Show a table, and compare it with the tables of other runs that have the same name."""
        path = self.folder / TABLES_NAME / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        write_whole(path, table.replace({float(INFINITE): INFINITE}).to_json(orient="split", index=False).encode())
        self._tell("table", path=os.path.relpath(path, self.folder), folder=TABLES_NAME)
        self.deliver()

    def log_checkpoint(self, path: Path, step: int, metrics: Mapping[str, float], is_final: bool = True) -> None:
        """Record a checkpoint as a model of this run, with its metrics at that step.

        The final one becomes a version of `tracking.registered_model`, if that is set. A copy stays in the run folder,
        so that it can be sent to a store at any time.
        """
        kept = self.folder / CHECKPOINTS_NAME / f"step_{step}" / path.name
        link_or_copy(path, kept)
        values = cleaned({key: float(value) for key, value in metrics.items()})
        name = self._tracking.registered_model if is_final else None
        place = str(kept.relative_to(self.folder))
        logged_step, logged_ms = self._logged
        # the store counts a metric of the run and one of the checkpoint as one where their times are equal
        time_ms = logged_ms if step == logged_step else None
        self._tell("checkpoint", time_ms, path=place, step=step, values=values, registered_model=name)
        self.deliver()

    def offer_comparison_view(self, metrics: Sequence[str], left_out: Collection[str]) -> None:
        """Offer a view of this run and others like it: the parameters that differ, beside the results.

        metrics: names as in metrics.json, `evaluation.yield.adaptive.reward`
        left_out: parameters that are not shown, with all below them
        """
        names = [clean_name(name.replace(".", "/")) for name in metrics]
        self._tell("view", metrics=names, left_out=sorted(left_out))
        self.deliver()

    def update_metrics_json(self, section: Mapping[str, Any]) -> None:
        """Merge `section` into the folder's metrics.json.

        The file holds results, without clock times and paths, so that two runs with one seed can be compared.
        Durations are the exception, by their keys.
        """
        merge_into(self.folder / METRICS_NAME, section)

    def set_description(self, markdown: str) -> None:
        """Set the text at the top of the run's page."""
        self.set_tags({"mlflow.note.content": markdown})

    def set_tags(self, tags: Mapping[str, str]) -> None:
        self._tell("tags", values=cleaned(tags))
        self.deliver()

    def _tell(self, kind: str, time_ms: int | None = None, **content: Any) -> int:
        self.begin()
        return self._journal.append(kind, time_ms, **content)

    def sync(self) -> None:
        """Write all entries so far to the disk, before later work is recorded as done."""
        self._journal.sync()

    def deliver(self) -> None:
        """Send waiting entries to the store, if it is in reach."""
        started_s = time.monotonic()
        if started_s < self._next_try_s:
            return
        try:
            self._delivery.deliver(self._client or self._connect())
        except unreachable() as error:
            self._next_try_s = time.monotonic() + _PAUSE_PER_TRY * (time.monotonic() - started_s)
            self._say_out_of_reach(error)
        else:
            self._say_in_reach()
            self._n_waiting = 0
        self._sent_s = time.monotonic()

    def close(self, status: str) -> None:
        """End the run: metrics.json becomes an artifact, the status becomes final, waiting entries are sent."""
        if self.has_begun:
            if (self.folder / METRICS_NAME).exists():
                self._tell("artifact", path=METRICS_NAME, folder="")
            self._tell("end", status=status)
        if not self._delivery.is_complete:
            self._next_try_s = 0.0
            self.deliver()
        if not self._delivery.is_complete:
            deliver = f"python -m negopipe.tracking.sync {shlex.quote(str(self._outputs))}"
            later = f"the same command sends them, or {deliver}"
            log.warning(f"store      lacks entries of {self.folder.name}: {later}")

    def _connect(self) -> "MlflowClient":
        with store_lock(self._outputs):
            client = connect(self._outputs, self._tracking.uri)
            try:
                close_dead_runs(client, self._delivery)
            except unreachable() as error:
                self._say_out_of_reach(error)
        self._client = client
        return client

    def _say_out_of_reach(self, error: Exception) -> None:
        if not self._is_out_of_reach:
            reason = first_line(error)
            log.warning(f"store      is out of reach, its entries wait in {self._journal.path}: {reason}")
        self._is_out_of_reach = True

    def _say_in_reach(self) -> None:
        if self._is_out_of_reach:
            log.info("store      is in reach again, waiting entries have been sent")
        self._is_out_of_reach = False


@contextmanager
def _final_status(run: TrackedRun) -> Iterator[None]:
    try:
        yield
    except Exception:
        _close_failed(run)
        raise
    except BaseException:  # Ctrl-C, SIGTERM
        run.close("KILLED")
        raise
    run.close("FINISHED")


def _close_failed(run: TrackedRun) -> None:
    """Close a failed run. The cause, such as a full disk, may prevent that: then the next start closes it."""
    try:
        run.close("FAILED")
    except OSError as error:
        log.warning(f"run        cannot be closed: {error}")


def _continued(record: RunRecord | None, accepted: str | None) -> RunRecord | None:
    """Record of the run to resume, if there is one."""
    if record is not None and accepted not in (None, record.source):
        log.info("run        starting anew: other code made the results in its folder (reuse=any_code accepts them)")
        return None
    return record


def _earlier_metrics(journal: Journal) -> tuple[dict[str, int], tuple[int, int]]:
    """Metrics that earlier processes of this run logged: last step of every metric; step and time of the latest one."""
    last: dict[str, int] = {}
    latest = (-1, 0)
    for _, entry in journal.after(0):
        if entry["kind"] == "metrics":
            last |= dict.fromkeys(entry["values"], entry["step"])
            latest = (entry["step"], entry["time_ms"])
    return last, latest
