"""A run's folder: what it holds, whose it is, and how it makes room for another run.

It belongs to one process at a time, the one that holds `<folder>/.lock`. The lock also tells who is alive.
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
"""Folder of a run in which an unfinished training is kept."""
CHECKPOINTS_NAME = "checkpoints"
"""... and that of the checkpoints which the store is given, a folder per step."""
TABLES_NAME = "tables"
"""... and that of the tables which it shows."""
CONFIG_NAME = "config.yaml"
LOCK_NAME = ".lock"


def lock(folder: Path) -> FileLock:
    """Take the folder, made if need be; UserError if another process has it."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK_NAME, blocking=False)
    try:
        lock.acquire()
    except Timeout as error:
        hint = "wait for it or change seed, name or outputs"
        raise UserError(f"the run folder {folder} is in use by another process: {hint}") from error
    return lock


def archive(folder: Path, lock: FileLock) -> bool:
    """Make room for another run: what is in the folder goes to `<folder>.old<n>`; False if there is nothing."""
    if {path.name for path in folder.iterdir()} <= {LOCK_NAME}:
        return False
    lock.release()
    places = (folder.with_name(f"{folder.name}.old{n}") for n in range(1, 10_000))
    place = next(path for path in places if not path.exists())
    folder.rename(place)
    log.info(f"run        {place.name} keeps what was there")
    return True


def link_or_copy(path: Path, kept: Path) -> None:
    """A second name for a file that is replaced as a whole when it changes, or else a copy."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.unlink(missing_ok=True)
    try:
        os.link(path, kept)
    except OSError:  # a file system that knows no links
        shutil.copyfile(path, kept)
