"""Tables of how exports agree with torch: a row per export."""

from pathlib import Path
from typing import Any

import pandas as pd

from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv


def row_name(folder: Path, backend: str) -> str:
    """Name of the row of an export: its folder's, and the backend's where that is not onnxruntime."""
    name = folder.resolve().name
    return name if backend == "onnxruntime" else f"{name} ({backend})"


def put_row(path: Path, kind: CsvKind, export: str, figures: dict[str, Any]) -> None:
    """Write the figures of an export into a table, in the place of its earlier row.

    export: `row_name`
    """
    row = pd.DataFrame([{"export": export, **figures}])
    tables = [read_csv(path, kind)] if path.is_file() else []
    others = [table[table["export"] != export] for table in tables]
    write_csv(path, pd.concat([*others, row], ignore_index=True), kind)
