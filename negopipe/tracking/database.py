"""The MLflow store: created once, opened by one process at a time, usable after a move."""

import logging
import os
import re
import sqlite3
import uuid
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

from filelock import FileLock

from negopipe.environment import default, variable
from negopipe.errors import UserError, abbreviate
from negopipe.tracking.sqlite import address, check_path, file_of, is_address, open_read_only

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
"""Settings with which MLflow does not wait for a server: entries that cannot be sent stay in the journal."""
_URI_KEY = "tracking.uri"
_CHECKED_BYTES = 100_000_000
"""Largest database that is checked as a whole at a start. A larger one would take seconds."""


def database_path(outputs: Path) -> Path:
    """SQLite file of an outputs folder; it need not exist."""
    return outputs.absolute() / "mlflow" / "mlflow.db"


def sqlite_file(outputs: Path, uri: str | None) -> Path | None:
    """SQLite file of the store at `uri`, None = that of `outputs`; None for another database and for a server.

    Nothing is created. Raises UserError where no such file is possible.
    """
    if uri is None:
        database = database_path(outputs)
        check_path(_draft(database), "outputs")
        return database
    if not is_address(uri):
        return None
    database = file_of(uri, _URI_KEY)
    check_path(database, _URI_KEY)
    if not database.parent.is_dir():
        raise UserError(f"{_URI_KEY} must name a file in an existing folder, got {abbreviate(uri)}")
    return database


def artifact_location(outputs: Path, uri: str | None) -> str | None:
    """Place of the artifacts of a store's new experiments; None where a server chooses it.

    It is beside the SQLite file, so that both can be moved together, and in `outputs` for any other database.
    """
    if is_served(uri):
        return None
    database = sqlite_file(outputs, uri)
    if database is None or uri is None:
        return (database_path(outputs).parent / "artifacts").as_uri()
    return database.with_name(f"{database.stem}-artifacts").as_uri()


def store_lock(outputs: Path) -> FileLock:
    """Lock that a process holds while it opens the store."""
    folder = database_path(outputs).parent
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / "store.lock")


def is_served(uri: str | None) -> bool:
    """Whether the store at `uri` is a server's, which chooses the place of artifacts."""
    return (uri or "").startswith(("http:", "https:"))


def connect(outputs: Path, uri: str | None) -> "MlflowClient":
    """Client of the store at `uri`, None = the database of `outputs`, which is created if need be.

    A server is not contacted yet. The caller holds `store_lock`. Raises UserError if MLflow cannot open `uri`, and
    OSError if it is a database that is out of reach.
    """
    database = sqlite_file(outputs, uri)
    if uri is None and database is not None:
        _check(database) if database.exists() else _create(database)
    elif database is not None and database.exists():
        _check(database)
    return _open(address(database, _URI_KEY) if database else str(uri))


def _open(uri: str) -> "MlflowClient":
    with _explained(uri):
        from mlflow import MlflowClient

        _set_tracking_uri(uri)
        return MlflowClient()


@contextmanager
def _explained(uri: str) -> Iterator[None]:
    """Context in which errors of MLflow and its database libraries become those of `connect`."""
    _be_impatient()
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import ArgumentError, SQLAlchemyError

    try:
        yield
    except (MlflowException, ArgumentError, ImportError, ValueError) as error:  # an unknown kind, driver or setting
        place = f"{_URI_KEY} must be a store that MLflow can open, got {without_password(uri)}"
        raise UserError(f"{place}: {first_line(error)}") from error
    except SQLAlchemyError as error:
        raise OSError(f"{without_password(uri)}: {first_line(error)}") from error


def _be_impatient() -> None:
    """Let MLflow report at once that a server or a database is out of reach; UserError for an invalid setting."""
    for name, value in _IMPATIENT.items():
        default(name, value)
        if not (variable(name) or "").isdecimal():
            raise UserError(
                f"the environment variable {name} must be a whole number, got {abbreviate(os.environ[name])}"
            )
    from mlflow.store.db import utils

    utils.MAX_RETRY_COUNT = 1  # it has no setting; 10 tries take 100 s
    for logger in ("mlflow", "alembic"):
        logging.getLogger(logger).setLevel(logging.WARNING)


def unreachable() -> tuple[type[Exception], ...]:
    """Exceptions of a store or a server that is out of reach."""
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    return MlflowException, SQLAlchemyError, OSError, UserError


def without_password(uri: str) -> str:
    """An address for a log line or an error: without its password, and cut where it is long."""
    return abbreviate(re.sub(r"(://[^/@:]*):[^/@]*@", r"\1:***@", uri))


def first_line(error: Exception) -> str:
    """First line of an error's text, at most 200 characters; the name of its type where the text is empty."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def _set_tracking_uri(uri: str) -> None:
    """Set the address for MLflow's model registry, which takes it from a global of the process.

    The environment variable is restored, since the next run of this process may have another store.
    """
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
        if "no such table" not in str(error):  # it is out of reach, not damaged
            raise OSError(str(error), str(database)) from error
        verdict = str(error)
    except sqlite3.DatabaseError as error:
        verdict = str(error)
    if verdict != "ok":
        mend = "move it away, then python -m negopipe.tracking.sync <outputs> makes it anew from the run folders"
        raise UserError(f"the store {database} is damaged ({verdict.splitlines()[-1]}): {mend}")


def _create(database: Path) -> None:
    """Create the database under another name first: MLflow can neither use nor repair an unfinished one."""
    for left_behind in database.parent.glob("*.draft"):
        left_behind.unlink()
    draft = _draft(database)  # a new name at every call: MLflow caches the databases it has opened
    with _explained(uri := address(draft, "outputs")):
        from mlflow import MlflowClient

        MlflowClient(uri)
    for companion in ("-wal", "-shm"):  # of a database that was moved away without them
        database.with_name(database.name + companion).unlink(missing_ok=True)
    os.replace(draft, database)
    with closing(sqlite3.connect(database)) as connection:  # write-ahead log: readers no longer block the writer
        connection.execute("PRAGMA journal_mode=WAL")


def _draft(database: Path) -> Path:
    """New name for an unfinished database, beside the final one."""
    return database.with_name(f"{uuid.uuid4().hex[:12]}.draft")


def follow_move(outputs: Path, uri: str | None) -> None:
    """Update the artifact locations of a SQLite store that was moved or mounted elsewhere.

    MLflow keeps absolute locations; afterwards they point to the folder beside the file. It is cheap without a move.
    """
    database = sqlite_file(outputs, uri)
    if database is None or not database.exists():
        return
    new = str(artifact_location(outputs, uri))
    ending = "/mlflow/artifacts" if uri is None else f"/{new.rpartition('/')[2]}"
    try:
        with closing(open_read_only(database)) as connection:
            rows = connection.execute("SELECT DISTINCT artifact_location FROM experiments").fetchall()
    except sqlite3.DatabaseError:  # damaged or no store: `connect` reports it
        return
    others = [old for (old,) in rows if old and old != new and old.endswith(ending)]
    moved = [old for old in others if _folder(new).exists() or not _folder(old).exists()]
    if moved:
        _replace_locations(database, moved, new)


def _folder(location: str) -> Path:
    """Folder of an artifact location, a `file://` address."""
    return Path(unquote(location.removeprefix("file://")))


def _replace_locations(database: Path, moved: list[str], new: str) -> None:
    with closing(sqlite3.connect(database)) as connection, connection:
        for old in moved:
            for table, column in _LOCATIONS:
                update = f"UPDATE {table} SET {column} = ? || substr({column}, ?) WHERE substr({column}, 1, ?) = ?"
                connection.execute(update, (new, len(old) + 1, len(old), old))
