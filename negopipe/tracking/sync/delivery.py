"""Delivery of a run's journal to a store: complete, in order and without repetition, also after interruptions.

Entries may be sent again after a crash: to the store, a metric of the same time, step and value, a tag or a file is not
new. It would duplicate runs, checkpoints and images, so these are looked for first.
"""

import json
import logging
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image
from pydantic import TypeAdapter

from negopipe.tracking.database import artifact_location
from negopipe.tracking.sync.journal import Journal
from negopipe.tracking.sync.saved_view import save_comparison
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

DELIVERED_NAME = "delivered.json"
KEY_TAG = "run_key"
"""Tag by which a run is found if the process died before it recorded the id."""

_OWN_STORE = "outputs"
_PARAMS_PER_CALL = 100
_METRICS_PER_CALL = 1000

log = logging.getLogger("negopipe")


@dataclass(frozen=True)
class Delivered:
    """Delivered part of a journal in a store: its first `n_bytes`, as the run `run_id` of an experiment."""

    run_id: str | None = None
    experiment_id: str = ""
    n_bytes: int = 0


class Delivery:
    """Delivery of one run folder's journal to one store.

    outputs: absolute path of the outputs folder
    uri: address of the store, None = the one in `outputs`
    store: name of the store in delivered.json
    """

    def __init__(self, folder: Path, journal: Journal, outputs: Path, uri: str | None) -> None:
        self.folder, self.journal, self.outputs, self.uri = folder, journal, outputs, uri
        self.store = uri or _OWN_STORE
        self.done = _read(folder).get(self.store, Delivered())
        self._is_checked = False

    @property
    def is_complete(self) -> bool:
        """Whether the store has all entries of the journal."""
        return self.done.n_bytes >= self.journal.n_bytes

    def deliver(self, client: "MlflowClient") -> None:
        """Send the missing entries.

        Raises MlflowException or OSError where the store is out of reach; entries that it received by then count.
        """
        if not self._is_checked:
            self._start_over_if_lost(client)
        before = self.done
        try:
            for n_bytes, entries in _together(self.journal.after(self.done.n_bytes)):
                self._send(client, entries)
                self.done = replace(self.done, n_bytes=n_bytes)
        finally:
            if self.done != before:
                self._write_down()

    def _start_over_if_lost(self, client: "MlflowClient") -> None:
        """Send all entries again to a store that was made anew and does not know the run."""
        from mlflow.exceptions import MlflowException

        if self.done.run_id is not None:
            try:
                client.get_run(self.done.run_id)
            except MlflowException as error:
                if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                    raise
                self.done = Delivered()
        self._is_checked = True

    def _send(self, client: "MlflowClient", entries: list[dict[str, Any]]) -> None:
        first = entries[0]
        match first["kind"]:
            case "begin":
                self._begin(client, first)
            case "metrics":
                self._send_metrics(client, entries)
            case "params":
                self._send_params(client, first["values"])
            case "tags":
                for key, value in first["values"].items():
                    client.set_tag(self._run_id, key, value)
            case "artifact":
                self._send_artifact(client, self.folder / first["path"], first["folder"])
            case "image":
                self._send_image(client, first)
            case "table":
                self._send_table(client, self.folder / first["path"], first["folder"])
            case "checkpoint":
                self._send_checkpoint(client, first)
            case "view":
                save_comparison(client, self.done.experiment_id, first["metrics"], first["left_out"])
            case "end":
                client.set_terminated(self._run_id, first["status"], first["time_ms"])

    @property
    def _run_id(self) -> str:
        assert self.done.run_id is not None, f"{self.journal.path} does not start with the entry begin"
        return self.done.run_id

    def _begin(self, client: "MlflowClient", entry: Mapping[str, Any]) -> None:
        """Create the run for its first process; set it running again for later ones."""
        tags = {**entry["tags"], KEY_TAG: entry["key"]}
        run = client.get_run(self.done.run_id) if self.done.run_id else self._find(client, entry)
        if run is None:
            experiment_id = self._experiment(client, entry["experiment"])
            run = client.create_run(experiment_id, entry["time_ms"], tags, entry["run_name"])
        else:
            if run.info.lifecycle_stage == "deleted":
                client.restore_run(run.info.run_id)
            client.update_run(run.info.run_id, status="RUNNING")
            for key, value in tags.items():
                client.set_tag(run.info.run_id, key, value)
        self.done = replace(self.done, run_id=run.info.run_id, experiment_id=run.info.experiment_id)
        self._write_down()

    def _find(self, client: "MlflowClient", entry: Mapping[str, Any]) -> "Run | None":
        experiment = client.get_experiment_by_name(entry["experiment"])
        if experiment is None:
            return None
        found = client.search_runs([experiment.experiment_id], f"tags.{KEY_TAG} = '{entry['key']}'", max_results=1)
        return found[0] if found else None

    def _experiment(self, client: "MlflowClient", name: str) -> str:
        from mlflow.exceptions import MlflowException

        try:
            return client.create_experiment(name, artifact_location(self.outputs, self.uri))
        except MlflowException as error:
            found = client.get_experiment_by_name(name)
            if error.error_code != "RESOURCE_ALREADY_EXISTS" or found is None:
                raise
        if found.lifecycle_stage == "deleted":
            client.restore_experiment(found.experiment_id)
        return found.experiment_id

    def _send_metrics(self, client: "MlflowClient", entries: list[dict[str, Any]]) -> None:
        from mlflow.entities import Metric

        metrics = [
            Metric(key, value, entry["time_ms"], entry["step"])
            for entry in entries
            for key, value in entry["values"].items()
        ]
        for start in range(0, len(metrics), _METRICS_PER_CALL):
            client.log_batch(self._run_id, metrics=metrics[start : start + _METRICS_PER_CALL])

    def _send_params(self, client: "MlflowClient", values: Mapping[str, str]) -> None:
        """Send the parameters that the run does not have yet: the store does not let them change."""
        from mlflow.entities import Param

        known = client.get_run(self._run_id).data.params
        params = [Param(key, value) for key, value in values.items() if key not in known]
        for start in range(0, len(params), _PARAMS_PER_CALL):
            client.log_batch(self._run_id, params=params[start : start + _PARAMS_PER_CALL])

    def _send_artifact(self, client: "MlflowClient", path: Path, folder: str) -> None:
        if not _is_there(path):
            return
        send = client.log_artifacts if path.is_dir() else client.log_artifact
        send(self._run_id, str(path), folder or None)

    def _send_image(self, client: "MlflowClient", entry: Mapping[str, Any]) -> None:
        path, step, time_ms = self.folder / entry["path"], entry["step"], entry["time_ms"]
        sent = [file.path for file in client.list_artifacts(self._run_id, "images")]
        if any(f"+step+{step}+timestamp+{time_ms}+" in name for name in sent) or not _is_there(path):
            return
        with Image.open(path) as image:
            picture = image.convert("RGB")
        client.log_image(self._run_id, picture, key=entry["key"], step=step, timestamp=time_ms, synchronous=True)

    def _send_table(self, client: "MlflowClient", path: Path, folder: str) -> None:
        """Send an artifact and mark it as a table with a tag: MLflow's `log_table` would append to existing rows."""
        from mlflow.utils.mlflow_tags import MLFLOW_LOGGED_ARTIFACTS

        self._send_artifact(client, path, folder)
        marked = json.loads(client.get_run(self._run_id).data.tags.get(MLFLOW_LOGGED_ARTIFACTS, "[]"))
        mark = {"path": f"{folder}/{path.name}", "type": "table"}
        if mark not in marked:
            client.set_tag(self._run_id, MLFLOW_LOGGED_ARTIFACTS, json.dumps([*marked, mark]))

    def _send_checkpoint(self, client: "MlflowClient", entry: Mapping[str, Any]) -> None:
        """Send a checkpoint as a model of the run and, if it has a registered name, as a version in the registry."""
        from mlflow.entities import LoggedModelOutput

        path, step = self.folder / entry["path"], entry["step"]
        if not _is_there(path):
            return
        if self._has_checkpoint(client, step):
            return
        model = client.create_logged_model(
            self.done.experiment_id, f"step_{step}", source_run_id=self._run_id, params={"step": str(step)}
        )
        client.log_model_artifact(model.model_id, str(path))
        client.finalize_logged_model(model.model_id, "READY")
        for key, value in entry["values"].items():
            client.log_metric(self._run_id, key, value, entry["time_ms"], step, model_id=model.model_id)
        if entry["registered_model"] is not None:
            self._register(client, entry["registered_model"], model.model_id)
        client.log_outputs(self._run_id, [LoggedModelOutput(model.model_id, step)])  # from now on it counts as sent

    def _has_checkpoint(self, client: "MlflowClient", step: int) -> bool:
        outputs = client.get_run(self._run_id).outputs
        return outputs is not None and any(output.step == step for output in outputs.model_outputs)

    def _register(self, client: "MlflowClient", name: str, model_id: str) -> None:
        from mlflow.exceptions import MlflowException

        try:
            client.create_registered_model(name)
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise
        client.create_model_version(name, f"models:/{model_id}", run_id=self._run_id, model_id=model_id)

    def _write_down(self) -> None:
        stores = {**_read(self.folder), self.store: self.done}
        content = {store: asdict(done) for store, done in stores.items()}
        write_whole(self.folder / DELIVERED_NAME, (json.dumps(content, indent=2) + "\n").encode())


def _is_there(path: Path) -> bool:
    """Whether the file exists; a warning where it was deleted."""
    if not path.exists():
        log.warning(f"store      does not receive {path}: the file was deleted")
    return path.exists()


def _read(folder: Path) -> dict[str, Delivered]:
    """Delivered parts by store; none where the file is damaged, since entries may be sent again."""
    path = folder / DELIVERED_NAME
    if not path.exists():
        return {}
    try:
        return TypeAdapter(dict[str, Delivered]).validate_json(path.read_bytes())
    except ValueError:
        log.warning(f"store      receives all entries again: {path} is damaged")
        return {}


def _together(entries: Iterator[tuple[int, dict[str, Any]]]) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """Groups of entries: neighbouring entries of metrics up to the size of one call, all others alone."""
    waiting: list[dict[str, Any]] = []
    n_values = end = 0
    for n_bytes, entry in entries:
        is_metrics = entry["kind"] == "metrics"
        if waiting and (not is_metrics or n_values >= _METRICS_PER_CALL):
            yield end, waiting
            waiting, n_values = [], 0
        if is_metrics:
            waiting.append(entry)
            n_values, end = n_values + len(entry["values"]), n_bytes
        else:
            yield n_bytes, [entry]
    if waiting:
        yield end, waiting
