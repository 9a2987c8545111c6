"""Independent jobs side by side, in processes of one thread each.

Tensors of the simulation are too small to gain from threads, so the cores of a machine are used by processes. They are
forked and share all objects of the jobs, among them the compiled game.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import active_children, get_context
from typing import Any, TypeVar

import torch

from negopipe.tensors.torch_settings import one_thread

T = TypeVar("T")

LOOK_S = 1.0
"""Time between two checks of a worker that its parent is alive, s."""

_inherited: Sequence[Callable[[], Any]] = ()
"""Jobs of a worker, inherited by the fork."""


def n_processes(device: str, n_threads: int) -> int:
    """Number of worker processes: the run's threads, but one on a GPU and where processes cannot be forked."""
    return n_threads if device == "cpu" and sys.platform == "linux" else 1


def side_by_side(jobs: Sequence[Callable[[], T]], n: int, on_done: Callable[[int], None]) -> list[T]:
    """Results of the jobs in their order; `on_done` is called with the index of each finished job.

    n: number of processes; with 1 the jobs run in this process, in one thread too, so that results do not depend on n
    Raises the error of a job and cancels the others. A killed process raises BrokenProcessPool.
    """
    if min(n, len(jobs)) <= 1:
        return _one_by_one(jobs, on_done)
    others = active_children()
    with ProcessPoolExecutor(min(n, len(jobs)), get_context("fork"), _begin, (jobs, os.getpid())) as pool:
        futures = {pool.submit(_do, index): index for index in range(len(jobs))}
        try:
            for future in as_completed(futures):
                future.result()
                on_done(futures[future])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(active_children()) - set(others):
                process.terminate()
            raise
    return [future.result() for future in futures]


@one_thread()
def _one_by_one(jobs: Sequence[Callable[[], T]], on_done: Callable[[int], None]) -> list[T]:
    results = []
    for index, job in enumerate(jobs):
        results.append(job())
        on_done(index)
    return results


def _begin(jobs: Sequence[Callable[[], Any]], parent: int) -> None:
    """Set a worker up: it ignores Ctrl-C, which the parent handles, and ends with its parent."""
    global _inherited
    _inherited = jobs
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process once its parent has ended."""
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)


def _do(index: int) -> Any:
    return _inherited[index]()
