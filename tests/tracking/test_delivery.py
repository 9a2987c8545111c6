"""What a run logs reaches the store complete, in order and once, whatever goes away meanwhile."""

import re
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from mlflow import MlflowClient
from mlflow.exceptions import MlflowException
from PIL import Image

from negopipe.errors import UserError
from negopipe.tracking import store
from negopipe.tracking.database import database_path
from negopipe.tracking.store import StoreConfig, TrackedRun, open_run
from negopipe.tracking.sync.__main__ import deliver
from negopipe.tracking.whole_file import write_whole

SENDING = (
    *("create_run", "log_batch", "set_tag", "log_artifact", "log_image"),
    *("create_logged_model", "log_outputs", "set_terminated"),
)
"""Calls in the middle of which a store may go away."""
TAGS = ("colour", "mlflow.note.content", "run_key", "mlflow.loggedArtifacts", "mlflow.loggedImages")
UUID = r"[0-9a-f]{8}-[0-9a-f-]{27}"


class Outage:
    """The store is out of reach while `is_on`; `n_before` calls get through first."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.is_on, self.n_before = False, 0
        for name in SENDING:
            monkeypatch.setattr(MlflowClient, name, self._failing(getattr(MlflowClient, name)))

    def start(self, n_before: int = 0) -> None:
        self.is_on, self.n_before = True, n_before

    def _failing(self, call: Any) -> Any:
        def outer(*arguments: Any, **more: Any) -> Any:
            if self.is_on and self.n_before == 0:
                raise MlflowException("API request failed: connection refused")
            self.n_before -= self.is_on
            return call(*arguments, **more)

        return outer


@pytest.fixture
def outage(monkeypatch: pytest.MonkeyPatch) -> Outage:
    monkeypatch.setattr(store, "_PAUSE_PER_TRY", 0)
    return Outage(monkeypatch)


@pytest.fixture
def eager(config: StoreConfig) -> StoreConfig:
    """Every metric is sent at once."""
    return replace(config, tracking=replace(config.tracking, n_metrics_per_flush=1))  # type: ignore[type-var]


def work(run: TrackedRun, n_steps: int = 6) -> None:
    """Something of every kind that a run can tell."""
    run.begin()
    for step in range(n_steps):
        run.log_metrics({"loss": step / 2, "train/return": -step}, step)
        if step % 3 == 2:
            write_whole(run.folder / "checkpoint.safetensors", f"weights {step}".encode())
            run.log_checkpoint(run.folder / "checkpoint.safetensors", step, {"loss": step / 2})
            picture = run.folder / f"{step}.png"
            Image.new("RGB", (4, 4), (step, 0, 0)).save(picture)
            run.log_image(picture, "pictures", step)
    run.set_tags({"colour": "red"})
    run.log_table("rows", pd.DataFrame({"a": [1, 2]}))
    run.set_description("# Done")
    run.update_metrics_json({"loss": 1.0})


def told(database: Path, name: str) -> Iterator[Any]:
    """All that a store knows of the run of that name, times and ids aside."""
    client = MlflowClient(f"sqlite:///{database}")
    with closing(sqlite3.connect(database)) as connection:
        query = "SELECT run_uuid FROM runs WHERE name = ? AND lifecycle_stage = 'active'"
        ((run_id,),) = connection.execute(query, (name,)).fetchall()
        rows = connection.execute("SELECT key, step, value FROM metrics WHERE run_uuid = ? ORDER BY rowid", (run_id,))
        yield rows.fetchall()
    run = client.get_run(run_id)
    yield run.info.status
    yield run.data.params
    yield {key: run.data.tags[key] for key in TAGS}
    folders = ("", "tables", "images")
    yield sorted(re.sub(UUID, "", file.path) for each in folders for file in client.list_artifacts(run_id, each))
    models = [(output.step, client.get_logged_model(output.model_id)) for output in run.outputs.model_outputs]
    for step, model in sorted(models, key=lambda each: each[0]):
        place = Path(model.artifact_location.removeprefix("file://")) / "checkpoint.safetensors"
        yield step, str(model.status), place.read_text(), [(m.key, m.value, m.step) for m in model.metrics]


def all_told(config: StoreConfig, run: TrackedRun) -> list[Any]:
    found = list(told(database_path(Path(config.outputs)), run.folder.name))
    assert found[1] == "FINISHED"
    assert found[0] == [
        (key, step, value) for step in range(6) for key, value in (("loss", step / 2), ("train/return", -step))
    ]
    images = [path for path in found[4] if path.startswith("images/")]
    assert [re.sub(r"timestamp.\d+", "", path) for path in images] == [
        f"images/pictures+step+{step}++{kind}" for step in (2, 5) for kind in ("+compressed.webp", ".png")
    ]
    assert "tables/rows.json" in found[4]
    assert [each[:3] for each in found[5:]] == [(step, "READY", f"weights {step}") for step in (2, 5)]
    return found


def told_afresh(config: StoreConfig, name: str) -> list[Any]:
    """Delivered and read without MLflow of this process, which goes on with the files that it has opened once."""
    subprocess.run([sys.executable, "-m", "negopipe.tracking.sync.__main__", config.outputs], check=True)
    database = database_path(Path(config.outputs))
    return list(told(database.rename(database.with_name("afresh.db")), name))


@pytest.mark.parametrize("n_before", [0, 1, 3, 6, 7, 13])
def test_a_store_that_goes_away_gets_all_of_it_later(
    eager: StoreConfig, outage: Outage, caplog: pytest.LogCaptureFixture, n_before: int
) -> None:
    with caplog.at_level("INFO"), open_run(eager, f"away-{n_before}", {"a": 1}) as run:
        outage.start(n_before)
        work(run)
        outage.is_on = False
    all_told(eager, run)
    lines = [record.message for record in caplog.records]
    assert sum("out of reach" in line for line in lines) == sum("in reach again" in line for line in lines) == 1


def test_what_waits_at_the_end_is_sent_by_the_same_command_or_by_another_one(
    eager: StoreConfig, outage: Outage, caplog: pytest.LogCaptureFixture
) -> None:
    for name, later in (("later-1", "same"), ("later-2", "deliver")):
        outage.start(5)
        with open_run(eager, name, {}) as run:
            work(run)
        assert "lacks entries of" in caplog.text
        outage.is_on = False
        if later == "same":
            with open_run(eager, name, {}):
                pass  # all of its stages are finished
        else:
            deliver(Path(eager.outputs), None)
        all_told(eager, run)


@pytest.mark.parametrize("lost", ["{}", "{", None])
def test_what_was_sent_but_not_written_down_is_not_there_twice(eager: StoreConfig, lost: str | None) -> None:
    name = f"twice-{lost}"
    with open_run(eager, name, {"a": 1}) as run:
        work(run)
    before = all_told(eager, run)
    delivered = run.folder / "delivered.json"
    if lost is None:
        delivered.unlink()
    else:
        delivered.write_text(lost)
    deliver(Path(eager.outputs), None)
    assert list(told(database_path(Path(eager.outputs)), name)) == before


def test_offline_results_move_to_another_store(
    ready: StoreConfig, new_database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with open_run(ready, "one", {"a": 1}) as run:
        work(run)
    before, there = all_told(ready, run), tmp_path / "there.db"
    shutil.copyfile(new_database, there)
    for _ in range(2):  # the second time there is nothing to do
        assert deliver(Path(ready.outputs), f"sqlite:///{there}") == 1
        assert list(told(there, "one")) == before
    assert capsys.readouterr().out.splitlines() == ["case/one  delivered"] * 2


def test_delivering_ends_dead_runs_and_leaves_others_alone(
    ready: StoreConfig,
    new_database: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copyfile(new_database, tmp_path / "there.db")
    with monkeypatch.context() as killed, open_run(ready, "dead", {}) as dead:
        killed.setattr(TrackedRun, "close", lambda *_: None)
        work(dead)
    with open_run(ready, "alive", {}) as alive:
        alive.begin()
        assert deliver(Path(ready.outputs), f"sqlite:///{tmp_path}/there.db") == 1
    with closing(sqlite3.connect(tmp_path / "there.db")) as connection:
        assert connection.execute("SELECT name, status FROM runs").fetchall() == [("dead", "KILLED")]
        assert connection.execute("SELECT COUNT(*) FROM metrics").fetchone() == (12,)
    assert capsys.readouterr().out.splitlines() == ["case/alive  in use, left alone", "case/dead  delivered"]


def test_a_damaged_store_is_said_so_and_made_anew_from_the_run_folders(ready: StoreConfig) -> None:
    with open_run(ready, "one", {"a": 1}) as run:
        work(run)
    before, database = all_told(ready, run), database_path(Path(ready.outputs))
    whole = database.read_bytes()
    for damage in (b"nonsense" * 1000, whole[: len(whole) // 2], b""):
        database.write_bytes(damage)
        with (
            pytest.raises(UserError, match=r"^the store \S+ is damaged \(.+\): move it away, then [^\n]+$"),
            open_run(ready, "two", {}) as other,
        ):
            other.begin()
    database.rename(database.with_suffix(".damaged"))
    assert told_afresh(ready, "one") == before


def test_only_an_outputs_folder_is_delivered(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="outputs must be a folder with runs"):
        deliver(tmp_path / "nothing", None)
