"""Tables as CSV files, written and read by the column types of a kind of file.

No type is guessed, so a name such as `NA`, `nan` or `12` remains a text. An empty cell is the empty text in a column of
texts and NaN in a column of numbers; whole numbers are never missing.
"""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pandas as pd

from negopipe.errors import UserError
from negopipe.tracking.whole_file import write_whole

LONGEST_CELL = 2**30
"""Longest cell that is read, in characters: the horizons of an hour exceed the default limit of Python's csv."""
EXPECTED = {int: "whole numbers", float: "numbers"}
"""Name of a column type in errors."""


@dataclass(frozen=True)
class CsvKind:
    """A kind of CSV file: its writer and its columns.

    made_by: the writer, for errors
    columns: name of each allowed column, or a pattern with `*` -> str, float or int; the first match counts
    float_format: printf format of the numbers; None = all digits, so that the same numbers are read back
    """

    made_by: str
    columns: Mapping[str, type]
    float_format: str | None = None

    @property
    def texts(self) -> "CsvKind":
        """The same kind of file with all columns read as texts."""
        return replace(self, columns={"*": str})

    def type_of(self, column: str) -> type | None:
        """Type of a column; None where this kind has no such column."""
        return next((type_ for pattern, type_ in self.columns.items() if fnmatchcase(column, pattern)), None)


def write_csv(path: Path, table: pd.DataFrame, kind: CsvKind) -> None:
    """Write the table without its index; ValueError if the kind has no such column."""
    write_whole(path, csv_text(table, kind).encode())


def read_csv(path: Path, kind: CsvKind, needs: Iterable[str] = ()) -> pd.DataFrame:
    """The table of a file; columns that the kind does not have are left out.

    needs: columns that the file must have

    Raises UserError with the file, the column and what is expected, where the file is not of this kind.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; {kind.made_by} writes it")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: must be a table as {kind.made_by} writes it ({error})") from error
    return parse_csv(text, kind, needs, str(path))


def csv_text(table: pd.DataFrame, kind: CsvKind) -> str:
    """Text that `write_csv` writes."""
    unknown = [column for column in table if kind.type_of(str(column)) is None]
    if unknown:
        raise ValueError(f"a table that {kind.made_by} writes has no column {unknown[0]}: add it to its CsvKind")
    return table.to_csv(index=False, float_format=kind.float_format)


def parse_csv(text: str, kind: CsvKind, needs: Iterable[str] = (), name: str = "the table") -> pd.DataFrame:
    """Table of a CSV text, as `read_csv` returns it; `name` stands for the file in errors."""
    header, rows = _cells(text, kind, name)
    for column in needs:
        if column not in header:
            raise UserError(f"{name}: must have a column {column} as {kind.made_by} writes it, got {', '.join(header)}")
    found = {column: [row[place] for row in rows] for place, column in enumerate(header)}
    typed = {column: kind.type_of(column) for column in header}
    return pd.DataFrame({c: _typed(found[c], type_, f"{name}: column {c}") for c, type_ in typed.items() if type_})


def _cells(text: str, kind: CsvKind, name: str) -> tuple[list[str], list[list[str]]]:
    """The header and the rows, all of the header's length."""
    csv.field_size_limit(LONGEST_CELL)
    expected = f"must be a table as {kind.made_by} writes it"
    try:
        lines = [row for row in csv.reader(io.StringIO(text, newline=""), strict=True) if row]
    except csv.Error as error:
        raise UserError(f"{name}: {expected} ({error})") from error
    if not lines:
        raise UserError(f"{name}: {expected}, got an empty file")
    header, *rows = lines
    for number, row in enumerate(rows, start=1):
        if len(row) != len(header):
            raise UserError(f"{name}: row {number} must have {len(header)} columns as the header has, got {len(row)}")
    return header, rows


def _typed(cells: Sequence[str], type_: type, place: str) -> pd.Series:
    if type_ is str:
        return pd.Series(cells, dtype="str")
    values = [_number(cell, type_, f"{place}, row {number}") for number, cell in enumerate(cells, start=1)]
    return pd.Series(values, dtype=np.int64 if type_ is int else np.float64)


def _number(cell: str, type_: type, place: str) -> float:
    try:
        return np.nan if cell == "" and type_ is float else type_(cell)
    except ValueError as error:
        raise UserError(f"{place}: must hold {EXPECTED[type_]}, got {cell[:80] or 'an empty cell'}") from error
