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


def connect(outputs: Path, uri: str | None) -> "MlflowClient":
    """A client of the store at `uri`, None = the database of `outputs`, which is made if need be.

    Hold `store_lock`. Raises UserError if MLflow cannot open `uri`.
    """
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException
    from mlflow.tracking import set_tracking_uri

    for logger in ("mlflow", "alembic"):
        logging.getLogger(logger).setLevel(logging.WARNING)
    try:
        if uri is None:
            database = database_path(outputs)
            _follow_move(database, outputs) if database.exists() else _create(database)
            uri = f"sqlite:///{database}"
        set_tracking_uri(uri)  # the model registry asks for it behind the client's back
        return MlflowClient()
    except MlflowException as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"tracking.uri must be a store that MLflow can open, got {uri}: {reason}") from error


def _create(database: Path) -> None:
    """Make the tables under another name: MLflow can neither use nor mend a database that is half made."""
    from mlflow import MlflowClient

    for left_behind in database.parent.glob("*.draft"):
        left_behind.unlink()
    draft = database.with_name(f"{uuid.uuid4().hex}.draft")  # a name anew: MLflow remembers what it has opened
    MlflowClient(f"sqlite:///{draft}")
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
