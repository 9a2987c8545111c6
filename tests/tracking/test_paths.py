"""Stores in folders of any name, after a move, and those that cannot be: said in one line before anything is made."""

import os
import shlex
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from mlflow import MlflowClient
from tracked import ready_at

from negopipe.errors import UserError
from negopipe.tracking import dashboard, database
from negopipe.tracking.checkpoint import find_checkpoint
from negopipe.tracking.database import artifact_location, connect, database_path, sqlite_file
from negopipe.tracking.sqlite import LONGEST_PATH, address, file_of
from negopipe.tracking.store import StoreConfig, TrackedRun, find_store, open_run

NAMES = ("a?b", "c#d", "e%f", "g%20h", "ä ö", "-x", "k=1&l@m:n", "o'p\"$q")


def at(config: StoreConfig, outputs: Path | str, uri: str | None = None) -> StoreConfig:
    return replace(config, outputs=str(outputs), tracking=replace(config.tracking, uri=uri))  # type: ignore[type-var]


def work(config: StoreConfig, name: str = "one") -> TrackedRun:
    with open_run(config, name, {"a": 1}) as run:
        run.log_metrics({"x": 1.0}, 0)
        file = run.folder / "checkpoint.safetensors"
        file.write_bytes(b"weights")
        run.log_checkpoint(file, 1, {})
    return run


def artifacts(config: StoreConfig, run: TrackedRun) -> list[str]:
    client = find_store(config)
    assert client is not None
    return sorted(file.path for file in client.list_artifacts(run.run_id))


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_may_have_any_name(ready: StoreConfig, new_database: Path, tmp_path: Path, name: str) -> None:
    place = tmp_path / "place"
    ready_at(new_database, place / name)
    config = at(ready, place / name)
    run = work(config)
    assert artifacts(config, run) == ["config.yaml"]
    assert find_checkpoint(str(run.run_id), config).read_bytes() == b"weights"
    assert [path.name for path in place.iterdir()] == [name], "nothing is made beside it"
    assert list(dashboard.chart_addresses(database_path(place / name), 5000)) == ["tests"]


def test_a_new_store_is_made_in_a_folder_of_any_name(ready: StoreConfig, tmp_path: Path) -> None:
    place = tmp_path / "place"
    run = work(at(ready, place / "a?b#c%20d"))
    assert run.run_id is not None
    assert [path.name for path in place.iterdir()] == ["a?b#c%20d"]


def test_a_relative_and_a_linked_folder_are_followed(
    ready: StoreConfig, new_database: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready_at(new_database, tmp_path / "real" / "a%b")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    monkeypatch.chdir(tmp_path)
    run = work(at(ready, "link/a%b"))
    assert artifacts(at(ready, tmp_path / "real" / "a%b"), run) == ["config.yaml"]


def long_folder(base: Path, n_bytes: int) -> Path:
    """A folder, not made, whose store's longest file name has that many bytes."""
    rest = n_bytes - len(os.fsencode(base)) - len("/mlflow/123456789012.draft")
    names = []
    while rest > 150:
        names.append("x" * 99)
        rest -= 100
    return base.joinpath(*names, "y" * (rest - 1))


def test_the_longest_path_is_what_sqlite_takes(tmp_path: Path) -> None:
    for n_bytes in (LONGEST_PATH, LONGEST_PATH + 1):
        folder = long_folder(tmp_path, n_bytes) / "mlflow"
        folder.mkdir(parents=True)
        with closing(sqlite3.connect(":memory:")) as connection:
            try:
                connection.execute("ATTACH ? AS longest", (str(folder / "123456789012.draft"),))
                connection.execute("CREATE TABLE longest.t (x)")
                is_taken = True
            except sqlite3.OperationalError:
                is_taken = False
        assert is_taken == (n_bytes == LONGEST_PATH)


def test_a_path_too_long_is_refused_before_anything_is_made(ready: StoreConfig, tmp_path: Path) -> None:
    sqlite_file(long_folder(tmp_path, LONGEST_PATH), None)
    outputs = long_folder(tmp_path, LONGEST_PATH + 1)
    too_long = pytest.raises(UserError, match=r"^outputs must lead to a database file of at most 504 bytes[^\n]+505: /")
    with too_long, open_run(at(ready, outputs), "one", {}):
        pass
    assert not (tmp_path / ("x" * 99)).exists()
    (tmp_path / "short").symlink_to(outputs)  # what counts is the path without links
    with pytest.raises(UserError, match="outputs must lead to a database file"):
        sqlite_file(tmp_path / "short", None)
    served = at(ready, outputs, "http://127.0.0.1:1")
    assert sqlite_file(Path(served.outputs), served.tracking.uri) is None, "a server's store may lie anywhere"


@pytest.mark.parametrize(
    ("uri", "line"),
    [
        ("sqlite:///x?y.db", r"tracking\.uri must be sqlite:///<file>, in it \? written as %3F and % as %25, got sqli"),
        ("sqlite://", r"tracking\.uri must be sqlite:///<file>"),
        ("sqlite:///:memory:", r"tracking\.uri must be sqlite:///<file>"),
        ("sqlite:///file:x?uri=true", r"tracking\.uri must be sqlite:///<file>"),
        ("sqlite:///no/such/folder/x.db", r"tracking\.uri must name a file in an existing folder"),
        ("sqlite:////tmp/a%0Ab.db", r"tracking\.uri must be a path of printable characters"),
        (f"sqlite:////tmp/{'x' * 600}", r"tracking\.uri must lead to a database file of at most 504 bytes"),
    ],
)
def test_an_address_of_no_file_is_refused_before_anything_is_made(
    ready: StoreConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uri: str, line: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=f"^{line}") as error, open_run(at(ready, "new", uri), "one", {}):
        pass
    assert "\n" not in str(error.value)
    assert not Path("new").exists()


@pytest.mark.parametrize(
    ("uri", "reason"),
    [
        ("postgresql+nodriver://u:secret@h/db", "Can't load plugin"),
        ("postgresql+psycopg2://u:secret@h/db", "No module named 'psycopg2'"),
        ("nonsense", ""),
    ],
)
def test_a_store_that_cannot_be_opened_is_one_line(ready: StoreConfig, uri: str, reason: str) -> None:
    refused = pytest.raises(UserError, match=r"^tracking\.uri must be a store that MLflow can open, got [^\n]+$")
    with refused as error, open_run(at(ready, ready.outputs, uri), "one", {}) as run:
        run.begin()
    assert reason in str(error.value)
    assert "secret" not in str(error.value)


def test_a_database_that_is_out_of_reach_is_waited_for(
    ready: StoreConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "is a folder.db").mkdir()
    config = at(ready, ready.outputs, f"sqlite:///{tmp_path}/there/is a folder.db")
    with open_run(config, "one", {}) as run:
        run.log_metrics({"x": 1.0}, 0)
    assert "is out of reach, its entries wait" in caplog.text
    assert (run.folder / "journal.jsonl").exists()


def test_one_that_cannot_be_reached_at_all_is_waited_for_too(
    ready: StoreConfig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from sqlalchemy.exc import OperationalError

    def refuse(*_: object, **__: object) -> None:
        raise OperationalError("", {}, Exception("could not connect to server"))

    monkeypatch.setattr("mlflow.MlflowClient.__init__", refuse)
    with open_run(ready, "one", {}) as run:
        run.log_metrics({"x": 1.0}, 0)
    assert "is out of reach, its entries wait" in caplog.text
    with pytest.raises(UserError, match=r"^checkpoint must be in a store that is in reach, got 0000"):
        find_checkpoint("0" * 32, ready)


def test_mlflow_does_not_retry_for_minutes(tmp_path: Path) -> None:
    from mlflow.store.db import utils

    connect(tmp_path, "http://127.0.0.1:1")
    assert utils.MAX_RETRY_COUNT == 1


@pytest.mark.parametrize("path", ["/x/a?b.db", "/x/c#d%e.db", "/x/g%20h.db", "/x/ä ö.db"])
def test_an_address_and_its_file_belong_together(path: str) -> None:
    assert file_of(address(Path(path), "key"), "key") == Path(path)


def moved(config: StoreConfig, run: TrackedRun, uri: str | None) -> list[str]:
    """Artifacts as a dashboard shows them, without any help of ours."""
    place = file_of(uri, "") if uri else database_path(Path(config.outputs))
    return sorted(file.path for file in MlflowClient(address(place, "")).list_artifacts(run.run_id))


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Addresses of the stores that dashboards were started on."""
    addresses: list[str] = []
    monkeypatch.setattr(dashboard, "_serve", lambda uri, port: addresses.append(uri))
    return addresses


@pytest.mark.parametrize("how", ["dashboard", "finished", "begun", "deliver"])
def test_artifacts_are_found_after_a_move(
    ready: StoreConfig, tmp_path: Path, served: list[str], how: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = work(ready)
    there = at(ready, Path(ready.outputs).rename(tmp_path / "mo?ved"))
    if how == "dashboard":
        assert dashboard.main([there.outputs]) == 0
        assert served == [address(database_path(Path(there.outputs)), "")]
    elif how == "finished":
        with open_run(there, "one", {"a": 1}) as again:
            assert not again.has_begun
    elif how == "begun":
        work(there, "two")
    else:
        from negopipe.tracking.sync.__main__ import deliver

        deliver(Path(there.outputs), None)
    assert moved(there, run, None) == ["config.yaml"]
    assert find_checkpoint(str(run.run_id), there).read_bytes() == b"weights"


def test_a_store_elsewhere_keeps_its_artifacts_beside_it(
    ready: StoreConfig, tmp_path: Path, new_database: Path, served: list[str]
) -> None:
    """... so that neither a move of the outputs nor one of both of its parts loses any."""
    (tmp_path / "here").mkdir()
    shutil.copyfile(new_database, tmp_path / "here" / "my.db")
    uri = f"sqlite:///{tmp_path}/here/my.db"
    config = at(ready, ready.outputs, uri)
    run = work(config)
    shutil.move(ready.outputs, tmp_path / "moved")
    assert moved(config, run, uri) == ["config.yaml"]
    (tmp_path / "here").rename(tmp_path / "there")
    uri = f"sqlite:///{tmp_path}/there/my.db"
    assert dashboard.main([uri, "5001"]) == 0
    assert moved(config, run, uri) == ["config.yaml"]
    alone = tmp_path / "my.db"  # without the artifacts, which stay where they are
    with closing(sqlite3.connect(tmp_path / "there" / "my.db")) as source, closing(sqlite3.connect(alone)) as copy:
        source.backup(copy)
    database.follow_move(Path(ready.outputs), f"sqlite:///{alone}")
    assert moved(config, run, f"sqlite:///{alone}") == ["config.yaml"]


def test_other_databases_keep_theirs_in_outputs_and_servers_their_own(tmp_path: Path) -> None:
    assert artifact_location(tmp_path, "postgresql://h/db") == (tmp_path / "mlflow" / "artifacts").as_uri()
    assert artifact_location(tmp_path, "http://127.0.0.1:1") is None


def test_the_command_that_is_named_shows_the_store_that_was_told(
    ready: StoreConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, served: list[str], new_database: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert dashboard.command_for(Path("outputs"), "http://127.0.0.1:1") is None
    (tmp_path / "Makefile").touch()
    assert dashboard.command_for(Path("outputs"), None) == "make ui"
    shutil.copyfile(new_database, tmp_path / "else where?.db")
    for outputs, uri in ((Path(ready.outputs), "sqlite:///else where%3F.db"), (tmp_path / "outputs", None)):
        (tmp_path / "Makefile").unlink(missing_ok=True)
        command = dashboard.command_for(outputs, uri)
        assert command is not None
        program, *arguments = shlex.split(command)
        assert [program, *arguments[:2]] == ["python", "-m", "negopipe.tracking.dashboard"]
        monkeypatch.chdir("/")  # it works from anywhere
        assert dashboard.main(arguments[2:]) == 0
        monkeypatch.chdir(tmp_path)
    assert served == [address(tmp_path / "else where?.db", ""), address(database_path(tmp_path / "outputs"), "")]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["nowhere"], "no runs are recorded in nowhere yet"),
        (["sqlite:////tmp/no such file.db"], "no runs are recorded in sqlite"),
        (["http://127.0.0.1:1"], "the store must be a folder or a database"),
        (["{outputs}", "many"], "the port must be a number from 1 to 65535, got many"),
        (["{outputs}", "70000"], "the port must be a number from 1 to 65535, got 70000"),
    ],
)
def test_what_cannot_be_shown_is_one_line(
    ready: StoreConfig,
    served: list[str],
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    line: str,
) -> None:
    assert dashboard.main([each.replace("{outputs}", ready.outputs) for each in arguments]) == 1
    said = capsys.readouterr().err
    assert said.startswith(line)
    assert said.count("\n") == 1
    assert served == []
