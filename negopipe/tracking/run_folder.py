"""Folder of a run: names of its files, its lock, and its archive.

It belongs to one process at a time, the one that holds `<folder>/.lock`. The lock also tells which run is alive.
"""

import logging
import os
import shutil
from pathlib import Path

from filelock import FileLock, Timeout

from negopipe.errors import UserError

log = logging.getLogger("negopipe")

METRICS_NAME = "metrics.json"
HISTORY_NAME = "history.csv"
TRAINING_EPISODES_NAME = "training_episodes.csv"
DEMONSTRATIONS_NAME = "demonstrations.csv"
SNAPSHOTS_NAME = "snapshots"
"""Folder with the snapshots of an unfinished training."""
CHECKPOINTS_NAME = "checkpoints"
"""Folder with copies of the checkpoints for the store, a folder per step."""
TABLES_NAME = "tables"
"""Folder with the tables for the store."""
CONFIG_NAME = "config.yaml"
LOCK_NAME = ".lock"


def lock(folder: Path) -> FileLock:
    """Lock of the folder, which is made if need be; UserError if another process holds it."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK_NAME, blocking=False)
    try:
        lock.acquire()
    except Timeout as error:
        hint = "wait for it or change seed, name or outputs"
        raise UserError(f"the run folder {folder} is in use by another process: {hint}") from error
    return lock


def archive(folder: Path, lock: FileLock) -> bool:
    """Rename the folder to `<folder>.old<n>`, to make room for another run; False if it is empty."""
    if {path.name for path in folder.iterdir()} <= {LOCK_NAME}:
        return False
    lock.release()
    places = (folder.with_name(f"{folder.name}.old{n}") for n in range(1, 10_000))
    place = next(path for path in places if not path.exists())
    folder.rename(place)
    log.info(f"run        earlier results moved to {place.name}")
    return True


def link_or_copy(path: Path, kept: Path) -> None:
    """Hard link to a file that is replaced as a whole when it changes, or else a copy."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.unlink(missing_ok=True)
    try:
        os.link(path, kept)
    except OSError:  # a file system without links
        shutil.copyfile(path, kept)
