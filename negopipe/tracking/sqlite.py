"""SQLite files: their allowed paths and their addresses."""

import os
import sqlite3
import sys
from pathlib import Path
from urllib.parse import unquote

from negopipe.environment import expanded
from negopipe.errors import UserError, abbreviate

LONGEST_PATH = 504
"""Longest path of a database that SQLite opens, in bytes, absolute and without symbolic links (measured)."""
_SCHEMES = ("sqlite:///", "sqlite+pysqlite:///")
_DRIVER = "sqlite+pysqlite"
"""Scheme of addresses with the driver. MLflow takes one without it for a plain path and makes folders `a%3Fb`."""


def check_path(database: Path, key: str) -> None:
    """UserError, with the key that the path comes from, where SQLite cannot open such a path."""
    n_bytes = len(os.fsencode(os.path.realpath(database)))
    if n_bytes > LONGEST_PATH:
        allowed = f"a database file of at most {LONGEST_PATH} bytes, as SQLite takes it"
        raise UserError(f"{key} must lead to {allowed}, got {n_bytes}: {abbreviate(str(database))}")


def address(database: Path, key: str) -> str:
    """Address of a file of any name for SQLAlchemy, and with it for MLflow and Optuna.

    key: key of the config, for the UserError about an impossible path
    """
    from sqlalchemy.engine import URL, make_url

    check_path(database, key)
    text = URL.create(_DRIVER, database=str(database.absolute())).render_as_string(hide_password=False)
    if make_url(text).database != str(database.absolute()):  # before SQLAlchemy 2.1
        raise UserError(f"{key} must have no ? and % with this version of SQLAlchemy, got {abbreviate(str(database))}")
    return text


def is_address(uri: str) -> bool:
    """Whether the address is one of SQLite."""
    return uri.partition(":")[0].partition("+")[0] == "sqlite"


def file_of(uri: str, key: str) -> Path:
    """File of a SQLite address; UserError where it names none."""
    rest = next((uri.removeprefix(scheme) for scheme in _SCHEMES if uri.startswith(scheme)), "")
    if "?" in rest or not rest.strip("/") or rest.startswith((":memory:", "file:")):
        allowed = "sqlite:///<file>, in it ? written as %3F and % as %25"
        raise UserError(f"{key} must be {allowed}, got {abbreviate(uri)}")
    try:
        path = expanded(unquote(rest))
    except ValueError as error:
        raise UserError(f"{key} {error}, got {abbreviate(uri)}") from error
    if not path.isprintable():
        raise UserError(f"{key} must be a path of printable characters, got {abbreviate(uri)}")
    return Path(path).absolute()


def open_read_only(database: Path) -> sqlite3.Connection:
    """Read-only connection."""
    return sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)


if __name__ == "__main__":  # python -m negopipe.tracking.sqlite <file>: its address, for scripts
    try:
        print(address(Path(sys.argv[1]), "the database"))
    except UserError as error:
        sys.exit(str(error))
