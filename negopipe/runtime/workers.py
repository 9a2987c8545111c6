"""Independent jobs side by side, in processes of one thread each.

What simulates has tensors too small to gain from threads, and a machine with many cores gains nothing from a driver
that uses one. The processes are forked, so they have all that the jobs refer to, the compiled game too.
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
"""How often a process looks whether the one that it works for is still there."""

_inherited: Sequence[Callable[[], Any]] = ()
"""The jobs, in a process that does them: a fork has them without anything being sent."""


def n_processes(device: str, n_threads: int) -> int:
    """How many may work side by side: as many as the run has threads, but one where a GPU does the work, and where
    processes cannot be forked.
    """
    return n_threads if device == "cpu" and sys.platform == "linux" else 1


def side_by_side(jobs: Sequence[Callable[[], T]], n: int, on_done: Callable[[int], None]) -> list[T]:
    """What the jobs return, in their order; `on_done` is told the index of each that is finished.

    n: processes; with 1 all is done here, in one thread as well, so that results do not depend on it
    Raises what a job raises, the others are given up then. A process that is killed makes BrokenProcessPool.
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
    """Of a process that works: Ctrl-C is the parent's matter, and without a parent there is nobody to work for."""
    global _inherited
    _inherited = jobs
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)


def _do(index: int) -> Any:
    return _inherited[index]()
