"""The store that MLflow keeps: made once, opened by one process at a time, found again after a move."""

import logging
import os
import sqlite3
import uuid
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock

from negopipe.errors import UserError

if TYPE_CHECKING:
    from mlflow import MlflowClient

_LOCATIONS = (
    ("experiments", "artifact_location"),
    ("runs", "artifact_uri"),
    ("logged_models", "artifact_location"),
    ("model_versions", "storage_location"),
)
"""Columns of MLflow's database that hold artifact locations."""

_IMPATIENT = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0", "MLFLOW_HTTP_REQUEST_TIMEOUT": "5"}
"""MLflow would wait for a server for minutes. Here what cannot be sent stays in the journal and is sent later."""
_SQLITE = "sqlite:///"
_CHECKED_BYTES = 100_000_000
"""Larger databases are not read through at a start: it would take seconds."""


def database_path(outputs: Path) -> Path:
    """The SQLite file of an outputs folder; it need not exist."""
    return outputs.absolute() / "mlflow" / "mlflow.db"


def artifact_location(outputs: Path) -> str:
    """Where experiments keep their artifacts: beside the database (MLflow would take the current folder)."""
    return (database_path(outputs).parent / "artifacts").as_uri()


def store_lock(outputs: Path) -> FileLock:
    """To be held while a process opens the store."""
    folder = database_path(outputs).parent
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / "store.lock")


def is_served(uri: str | None) -> bool:
    """The store at `uri` is a server's, which knows where to keep artifacts."""
    return (uri or "").startswith(("http:", "https:"))


def connect(outputs: Path, uri: str | None) -> "MlflowClient":
    """A client of the store at `uri`, None = the database of `outputs`, which is made if need be.

    A server is not asked yet whether it is there. Hold `store_lock`. Raises UserError if MLflow cannot open `uri`.
    """
    for name, value in _IMPATIENT.items():
        os.environ.setdefault(name, value)
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    for logger in ("mlflow", "alembic"):
        logging.getLogger(logger).setLevel(logging.WARNING)
    try:
        if uri is None:
            database = database_path(outputs)
            if database.exists():
                _check(database)
                _follow_move(database, outputs)
            else:
                _create(database)
            uri = f"{_SQLITE}{database}"
        elif uri.startswith(_SQLITE):
            _check_place(Path(uri.removeprefix(_SQLITE)))
        _set_tracking_uri(uri)
        return MlflowClient()
    except MlflowException as error:
        reason = str(error).splitlines()[0][:200]
        raise UserError(f"tracking.uri must be a store that MLflow can open, got {uri}: {reason}") from error


def _check_place(database: Path) -> None:
    if database.exists():
        _check(database)
    elif not database.parent.is_dir():
        raise UserError(f"tracking.uri must name a file in an existing folder, got {_SQLITE}{database}")


def _set_tracking_uri(uri: str) -> None:
    """For the model registry, which asks for it behind the client's back; the environment stays as it was, since
    the next run of this process may have another store."""
    from mlflow.tracking import set_tracking_uri

    before = os.environ.get("MLFLOW_TRACKING_URI")
    set_tracking_uri(uri)
    if before is None:
        os.environ.pop("MLFLOW_TRACKING_URI", None)
    else:
        os.environ["MLFLOW_TRACKING_URI"] = before


def _check(database: Path) -> None:
    """UserError if the file is damaged: MLflow would try to open it for minutes."""
    try:
        with closing(sqlite3.connect(database)) as connection:
            connection.execute("SELECT version_num FROM alembic_version").fetchone()
            is_quick = database.stat().st_size <= _CHECKED_BYTES
            (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone() if is_quick else ("ok",)
    except sqlite3.OperationalError as error:
        if "no such table" not in str(error):  # not damaged but out of reach
            raise OSError(str(error), str(database)) from error
        verdict = str(error)
    except sqlite3.DatabaseError as error:
        verdict = str(error)
    if verdict != "ok":
        mend = "move it away, then python -m negopipe.tracking.deliver <outputs> makes it anew from the run folders"
        raise UserError(f"the store {database} is damaged ({verdict.splitlines()[-1]}): {mend}")


def _create(database: Path) -> None:
    """Make the tables under another name: MLflow can neither use nor mend a database that is half made."""
    from mlflow import MlflowClient

    for left_behind in database.parent.glob("*.draft"):
        left_behind.unlink()
    draft = database.with_name(f"{uuid.uuid4().hex}.draft")  # a name anew: MLflow remembers what it has opened
    MlflowClient(f"sqlite:///{draft}")
    for companion in ("-wal", "-shm"):  # of a database that was moved away without them
        database.with_name(database.name + companion).unlink(missing_ok=True)
    os.replace(draft, database)
    with closing(sqlite3.connect(database)) as connection:  # write-ahead log: readers no longer block the writer
        connection.execute("PRAGMA journal_mode=WAL")


def _follow_move(database: Path, outputs: Path) -> None:
    """MLflow keeps absolute locations; after `outputs` was moved or mounted elsewhere, let them point to it."""
    new = artifact_location(outputs)
    query = "SELECT artifact_location FROM experiments WHERE artifact_location LIKE '%/mlflow/artifacts'"
    with closing(sqlite3.connect(database)) as connection, connection:
        (old,) = connection.execute(query).fetchone() or (new,)
        if old == new:
            return
        for table, column in _LOCATIONS:
            update = f"UPDATE {table} SET {column} = ? || substr({column}, ?) WHERE substr({column}, 1, ?) = ?"
            connection.execute(update, (new, len(old) + 1, len(old), old))
