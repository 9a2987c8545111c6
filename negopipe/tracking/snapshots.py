"""Snapshots of unfinished work: the latest few, each written whole and read without running code."""

import logging
import shutil
from pathlib import Path
from typing import Any

from torch import Tensor

from negopipe.errors import UserError
from negopipe.tracking.checkpoint import load_checkpoint, save_checkpoint

log = logging.getLogger("negopipe")


class Snapshots:
    """A folder of snapshots, one file each, named by the step after which it was taken.

    n_kept: number of snapshots that are kept; older ones are deleted. A damaged snapshot is skipped for the one before
    """

    def __init__(self, folder: Path, n_kept: int) -> None:
        self.folder, self.n_kept = folder, n_kept

    def save(self, step: int, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
        """Add the snapshot of `step`; a process that is killed meanwhile leaves the earlier ones."""
        save_checkpoint(self.folder / f"{step:09d}.safetensors", tensors, metadata)
        for path in self._paths()[: -self.n_kept]:
            path.unlink()

    def newest(self) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        """Tensors and metadata of the newest whole snapshot; None where there is none."""
        for path in reversed(self._paths()):
            try:
                return load_checkpoint(path)
            except UserError as error:
                log.warning(f"snapshot   left out: {error}")
        return None

    def remove(self) -> None:
        """Delete all snapshots, once the work is finished."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _paths(self) -> list[Path]:
        return sorted(self.folder.glob("[0-9]*.safetensors"))
