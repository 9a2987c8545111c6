"""A start closes what dead processes left in its own outputs folder, and touches nothing else in a store."""

import json
import shutil
import socket
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock
from mlflow import MlflowClient

from negopipe.tracking.store import StoreConfig, TrackedRun, find_store, open_run
from negopipe.tracking.sync.__main__ import deliver
from negopipe.tracking.sync.dead_runs import close_dead_runs
from negopipe.tracking.sync.delivery import Delivery
from negopipe.tracking.sync.journal import Journal, has_ended

Died = Callable[..., TrackedRun]


@pytest.fixture
def died(monkeypatch: pytest.MonkeyPatch) -> Died:
    """Leaves a run as kill -9 leaves it: begun, not ended, its lock free."""

    def die(config: StoreConfig, name: str) -> TrackedRun:
        with monkeypatch.context() as killed, open_run(config, name, {}) as run:
            killed.setattr(TrackedRun, "close", lambda *_: None)
            run.begin()
        return run

    return die


def start(config: StoreConfig, name: str = "next", **more: bool) -> TrackedRun:
    with open_run(config, name, {}, **more) as run:
        run.begin()
    return run


def status(config: StoreConfig, run_id: str | None) -> str:
    client = find_store(config)
    assert client is not None
    return client.get_run(run_id).info.status


def at(config: StoreConfig, **changes: object) -> StoreConfig:
    return replace(config, **changes)  # type: ignore[type-var]


def told_to(config: StoreConfig, database: Path) -> StoreConfig:
    return at(config, tracking=replace(config.tracking, uri=f"sqlite:///{database}"))


def test_a_dead_run_of_ours_is_closed_at_the_next_start(ready: StoreConfig, died: Died) -> None:
    dead = died(ready, "dead")
    with open_run(ready, "alive", {}) as alive:
        alive.begin()
        start(ready)
        assert status(ready, dead.run_id) == "KILLED"
        assert status(ready, alive.run_id) == "RUNNING"
    assert status(ready, alive.run_id) == "FINISHED"


def test_one_that_was_set_aside_is_closed_too(ready: StoreConfig, died: Died) -> None:
    dead = died(ready, "again")
    anew = start(ready, "again", is_fresh=True)
    assert anew.run_id != dead.run_id
    assert (anew.folder.with_name("again.old1") / "journal.jsonl").is_file()
    assert status(ready, dead.run_id) == "KILLED"
    assert status(ready, anew.run_id) == "FINISHED"


def test_no_run_of_others_in_a_shared_store_is_touched(
    ready: StoreConfig, died: Died, tmp_path: Path, new_database: Path
) -> None:
    """Neither one without a folder, nor one of a container of the same host name, nor one of another outputs folder
    (its folder there or not)."""
    shared = shutil.copyfile(new_database, tmp_path / "shared.db")
    ours = told_to(ready, shared)
    theirs = died(at(ours, outputs=str(tmp_path / "theirs")), "dead")
    dead = died(ours, "dead")
    client = find_store(ours)
    assert client is not None
    here, experiment = socket.gethostname(), client.get_run(dead.run_id).info.experiment_id
    tags = (
        {"host": here},
        {"host": here, "folder": "/nowhere", "pid": "1"},
        {"host": here, "folder": str(dead.folder), "pid": "1"},
        {"host": here, "folder": str(tmp_path), "run_key": "of another"},
    )
    foreign = [client.create_run(experiment, tags=each).info.run_id for each in tags]
    foreign.append(client.create_run(client.create_experiment("other"), tags=tags[1]).info.run_id)
    start(ours)
    assert {status(ours, run_id) for run_id in [*foreign, theirs.run_id]} == {"RUNNING"}
    assert status(ours, dead.run_id) == "KILLED"


def test_a_run_is_closed_in_the_store_that_it_reported_to(
    ready: StoreConfig, died: Died, tmp_path: Path, new_database: Path
) -> None:
    other = told_to(ready, shutil.copyfile(new_database, tmp_path / "other.db"))
    dead = died(other, "dead")
    start(ready, "here")
    client = find_store(ready)
    assert client is not None
    names = [run.info.run_name for run in client.search_runs([e.experiment_id for e in client.search_experiments()])]
    assert names == ["here"], "the store of the outputs is not told of a run that never reported to it"
    assert status(other, dead.run_id) == "RUNNING"
    start(other, "there")
    assert status(other, dead.run_id) == "KILLED"


def test_a_copy_of_a_folder_proves_nothing(ready: StoreConfig, died: Died, tmp_path: Path, new_database: Path) -> None:
    """The original may be alive: in the copy nobody holds the lock."""
    ours = told_to(ready, shutil.copyfile(new_database, tmp_path / "shared.db"))
    with open_run(ours, "alive", {}) as alive:
        alive.begin()
        shutil.copytree(ours.outputs, tmp_path / "copy")
        start(at(ours, outputs=str(tmp_path / "copy")))
        assert status(ours, alive.run_id) == "RUNNING"


def test_a_folder_that_is_being_taken_is_left_alone(ready: StoreConfig, died: Died) -> None:
    dead = died(ready, "dead")
    with FileLock(dead.folder / ".lock"):
        start(ready)
        assert not has_ended(dead.folder / "journal.jsonl")
    assert status(ready, dead.run_id) == "RUNNING"


def test_a_journal_ends_only_when_the_store_was_told_the_rest(
    ready: StoreConfig, died: Died, monkeypatch: pytest.MonkeyPatch
) -> None:
    dead = died(ready, "dead")
    with monkeypatch.context() as out_of_reach:

        def away(*_: object) -> None:
            raise OSError("no route to the store")

        out_of_reach.setattr(MlflowClient, "get_run", away)
        start(ready, "first")
    assert not has_ended(dead.folder / "journal.jsonl")
    start(ready, "second")
    assert status(ready, dead.run_id) == "KILLED"


def test_what_cannot_be_read_or_was_written_before_locks_were_noted_stops_nobody(
    ready: StoreConfig, died: Died, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = died(ready, "broken")
    journal = broken.folder / "journal.jsonl"
    journal.write_text("{nonsense\n" + journal.read_text())
    before = died(ready, "before")
    earlier = before.folder / "journal.jsonl"
    first, _, rest = earlier.read_text().partition("\n")
    entry = {key: value for key, value in json.loads(first).items() if key not in ("store", "lock")}
    earlier.write_text(json.dumps(entry).ljust(len(first)) + "\n" + rest)
    start(ready)
    assert "broken is left as it is, its journal cannot be read" in caplog.text
    assert status(ready, before.run_id) == "RUNNING"
    assert not has_ended(earlier)
    assert deliver(Path(ready.outputs), None) == 2
    assert "case/broken  left as it is, its journal cannot be read" in capsys.readouterr().out
    assert status(ready, before.run_id) == "KILLED"


@pytest.mark.parametrize(
    ("tail", "ended"),
    [
        ("", False),
        ('{"kind": "end", "time_ms": 1, "status": "FINISHED"}\n', True),
        ('{"kind": "end", "time_ms": 1, "status": "FINISHED"}\n{"kind": "begin", "ti', True),
        ('{"kind": "end", "time_ms": 1, "status": "FINISHED"}\n{"kind": "begin", "time_ms": 2}\n', False),
        (f'{{"kind": "params", "values": {{"a": "{"x" * 3000}"}}}}\n', False),
    ],
)
def test_the_last_line_tells_whether_a_run_has_ended(tmp_path: Path, tail: str, ended: bool) -> None:
    path = tmp_path / "journal.jsonl"
    path.write_text(f'{{"kind": "begin", "time_ms": 0, "tags": {{"a": "{"y" * 1000}"}}}}\n' + tail)
    before = path.read_bytes()
    assert has_ended(path) == ended
    assert path.read_bytes() == before


def test_thousands_of_finished_runs_cost_little(tmp_path: Path) -> None:
    for number in range(2000):
        folder = tmp_path / "case" / f"seed{number}"
        folder.mkdir(parents=True)
        end = '{"kind": "end", "time_ms": 1, "status": "FINISHED"}\n'
        (folder / "journal.jsonl").write_text('{"kind": "begin", "time_ms": 0}\n' + end)
    own = tmp_path / "case" / "own"
    own.mkdir()
    started_s = time.process_time()
    close_dead_runs(MlflowClient(), Delivery(own, Journal(own), tmp_path, None))
    assert time.process_time() - started_s < 2.0
    assert not list(tmp_path.glob("*/*/.lock")), "finished runs are not even locked"
