"""A tracked run without a store, for tests of single stages, and a store without runs."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

from negopipe.tracking.database import database_path
from negopipe.tracking.metrics_file import merge_into, read
from negopipe.tracking.run_folder import METRICS_NAME

Command = Callable[..., tuple[int, str, str]]
"""Runs the command line: arguments -> exit code, stdout, stderr."""


def ready_at(new_database: Path, outputs: Path) -> None:
    """Put a copy of a new store into an outputs folder: making one takes MLflow a second or two."""
    database_path(outputs).parent.mkdir(parents=True)
    shutil.copyfile(new_database, database_path(outputs))


class RecordedRun:
    """Remembers what a stage gives it.

    artifacts: (file name, artifact folder) each
    metrics: what went to the store
    images: (key, step) each
    tables: by their names
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.description = folder, ""
        self.artifacts: list[tuple[str, str]] = []
        self.metrics: dict[str, float] = {}
        self.tags: dict[str, str] = {}
        self.images: list[tuple[str, int]] = []
        self.tables: dict[str, pd.DataFrame] = {}
        self.commands = ["python -m negopipe +experiment=recorded"]

    @property
    def sections(self) -> dict[str, Any]:
        """The parts of metrics.json."""
        return read(self.folder / METRICS_NAME)

    def log_artifact(self, path: Path, artifact_folder: str = "") -> None:
        assert path.exists()
        self.artifacts.append((path.name, artifact_folder))

    def log_metrics(self, metrics: dict[str, float], step: int) -> None:
        self.metrics |= metrics

    def log_checkpoint(self, path: Path, step: int, metrics: dict[str, float], is_final: bool = True) -> None:
        self.log_artifact(path, f"step_{step}")

    def log_image(self, path: Path, key: str, step: int) -> None:
        assert path.read_bytes().startswith(b"\x89PNG")
        self.images.append((key, step))

    def log_table(self, name: str, table: pd.DataFrame) -> None:
        self.tables[name] = table

    def sync(self) -> None:
        pass

    def update_metrics_json(self, section: dict[str, Any]) -> None:
        merge_into(self.folder / METRICS_NAME, section)

    def set_tags(self, tags: dict[str, str]) -> None:
        self.tags |= tags

    def set_description(self, markdown: str) -> None:
        self.description = markdown
