"""Runs of this outputs folder whose process died: their rest is sent to the store, and they are closed as KILLED.

The store is not searched for them, since other machines and containers of the same name may report to it. A run is dead
if the journal in its folder has begun and not ended, and the lock that its process held is free.
"""

import logging
import os
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from negopipe.tracking.run_folder import LOCK_NAME
from negopipe.tracking.sync.delivery import Delivery
from negopipe.tracking.sync.journal import JOURNAL_NAME, Journal, has_ended

if TYPE_CHECKING:
    from mlflow import MlflowClient

log = logging.getLogger("negopipe")


def process_tags(folder: Path) -> dict[str, str]:
    """Tags of a run with the place of its process, for readers of the store."""
    return {"host": socket.gethostname(), "pid": str(os.getpid()), "folder": str(folder)}


def lock_id(folder: Path) -> int:
    """Identity of a run folder's lock, which differs from that of a copy of the folder: no process holds the copy's."""
    return (folder / LOCK_NAME).stat().st_ino


def close_if_dead(folder: Path, outputs: Path, uri: str | None, client: "MlflowClient") -> Delivery | None:
    """Send the rest of a run to a store, as KILLED if it did not end; None if a process works on it.

    Raises MlflowException or OSError where the store is out of reach.
    """
    try:
        with FileLock(folder / LOCK_NAME, blocking=False):
            return _end(folder, outputs, uri, client)
    except Timeout:
        return None


def close_dead_runs(client: "MlflowClient", own: Delivery) -> None:
    """Close the dead runs of the outputs folder that reported to the store of `own`.

    own: delivery of this process's run
    The caller holds `store_lock`, so that no process takes a folder meanwhile. Raises MlflowException or OSError where
    the store is out of reach; then the next start closes them.
    """
    for path in own.outputs.glob(f"*/*/{JOURNAL_NAME}"):
        if path.parent != own.folder and _may_be_dead(path):
            _close_own(path.parent, client, own)


def _may_be_dead(journal: Path) -> bool:
    try:
        return not has_ended(journal)
    except OSError:  # deleted meanwhile, or not readable
        return False


def _close_own(folder: Path, client: "MlflowClient", own: Delivery) -> None:
    try:
        lock = FileLock(folder / LOCK_NAME, blocking=False)
        lock.acquire()
    except (Timeout, OSError):  # alive, or without permission
        return
    try:
        begun = _begun(Journal(folder))
        if begun is not None and (begun.get("store"), begun.get("lock")) == (own.store, lock_id(folder)):
            _end(folder, own.outputs, own.uri, client)
    except (ValueError, KeyError) as error:
        log.warning(f"run        {folder} is left as it is, its journal cannot be read: {error}")
    finally:
        lock.release()


def _end(folder: Path, outputs: Path, uri: str | None, client: "MlflowClient") -> Delivery:
    """Deliver a dead run, then end it in its journal. After the end no later start would look at it again."""
    journal = Journal(folder)
    delivery = Delivery(folder, journal, outputs, uri)
    delivery.deliver(client)
    if _begun(journal) is not None:
        journal.append("end", status="KILLED")
        delivery.deliver(client)
    return delivery


def _begun(journal: Journal) -> dict[str, Any] | None:
    """Last entry `begin` of a journal; None where the run has not begun or has ended since."""
    last = None
    for _, entry in journal.after(0):
        if entry["kind"] in ("begin", "end"):
            last = entry
    return last if last and last["kind"] == "begin" else None
