"""Runs that say RUNNING in a store while no process holds their folder: they are told to the end and closed."""

import os
import socket
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from negopipe.tracking.delivery import Delivery
from negopipe.tracking.journal import Journal
from negopipe.tracking.run_folder import LOCK_NAME

if TYPE_CHECKING:
    from mlflow import MlflowClient

HOST_TAG, FOLDER_TAG, PID_TAG = "host", "folder", "pid"


def process_tags(folder: Path) -> dict[str, str]:
    """By these the next start finds the run, should this process die."""
    return {HOST_TAG: socket.gethostname(), PID_TAG: str(os.getpid()), FOLDER_TAG: str(folder)}


def close_if_dead(folder: Path, outputs: Path, uri: str | None, client: "MlflowClient") -> Delivery | None:
    """Tell a store the rest of a run, and that it was KILLED if it did not end; None if a process works on it.

    Raises MlflowException or OSError where the store is out of reach.
    """
    try:
        with FileLock(folder / LOCK_NAME, blocking=False):
            journal = Journal(folder)
            kinds = [entry["kind"] for _, entry in journal.after(0) if entry["kind"] in ("begin", "end")]
            if kinds and kinds[-1] == "begin":
                journal.append("end", status="KILLED")
            delivery = Delivery(folder, journal, outputs, uri)
            delivery.deliver(client)
            return delivery
    except Timeout:
        return None


def close_dead_runs(client: "MlflowClient", own: Delivery) -> None:
    """Close in the store of `own`, the delivery of this process's run, what dead processes of this host left.

    Raises MlflowException or OSError where the store is out of reach.
    """
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    is_ours = f"attributes.status = 'RUNNING' and tags.{HOST_TAG} = '{socket.gethostname()}'"
    for found in client.search_runs(experiments, is_ours):
        run_id, folder = found.info.run_id, Path(found.data.tags[FOLDER_TAG])
        if run_id == own.done.run_id:
            continue
        if folder != own.folder and folder.exists():
            delivery = close_if_dead(folder, own.outputs, own.uri, client)
            if delivery is None or delivery.done.run_id == run_id:
                continue
        client.set_terminated(run_id, "KILLED")
