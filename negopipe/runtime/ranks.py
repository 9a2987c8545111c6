"""Processes of one run, as `torchrun` starts them: gloo connects them, and NCCL their GPUs.

    torchrun --nproc-per-node 2 -m negopipe +experiment=yield 'stages=[train]'

The first rank runs the command as a single process would. The others wait until it calls them to train, and end after
that. They write nothing and say nothing, unless the first one is gone.
"""

import hashlib
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import cache
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed as dist
from torch import Tensor

from negopipe.errors import UserError, abbreviate
from negopipe.tensors.ranks import ALONE, ConnectedRanks, LostRankError, Ranks

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

log = logging.getLogger("negopipe")

PATIENCE = timedelta(minutes=30)
"""Longest wait in a collective. The end of a process is noticed at once; this is for a machine that vanishes."""
CONNECT = timedelta(seconds=60)
"""Longest wait for the store through which the processes find each other."""
EXPLAIN_S = 1.0
"""Time in which a rank that has failed says why, before another ends or tells that it has lost it, s."""


def n_started() -> int:
    """Number of processes of this run; 1 without `torchrun`."""
    return int(os.environ.get("WORLD_SIZE") or 1)


def n_local() -> int:
    """Number of those on this machine."""
    return int(os.environ.get("LOCAL_WORLD_SIZE") or 1)


def is_first() -> bool:
    """Whether this process is the first rank."""
    return n_started() == 1 or _own_number() == 0


class Processes(ConnectedRanks):
    """This process among those of `torchrun`; collectives of CPU tensors go through gloo, of CUDA tensors by NCCL.

    has_called: whether the first rank has said what the others do
    """

    def __init__(self) -> None:
        super().__init__(dist.get_rank(), dist.get_world_size())
        self.has_called = False

    def call(self, order: Any) -> None:
        self.has_called = True
        self.first(lambda: order)

    def close(self) -> None:
        if dist.is_initialized():
            dist.destroy_process_group()

    def _tell(self, lost: LostRankError) -> None:
        # torchrun sends SIGTERM to those that are left, which are about to end anyway: the line comes first
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            signal.signal(signal.SIGALRM, signal.SIG_IGN)
        if says_loss():
            print(lost, file=sys.stderr, flush=True)

    def _add_up(self, tensor: Tensor) -> None:
        dist.all_reduce(tensor)

    def _gather(self, tensor: Tensor) -> list[Tensor]:
        gathered = [torch.empty_like(tensor) for _ in range(self.number)]
        dist.all_gather(gathered, tensor)
        return gathered

    def _send(self, tensor: Tensor) -> None:
        dist.broadcast(tensor, src=0)


@contextmanager
def connected(config: "RunConfig") -> Iterator[Ranks]:
    """Context with the ranks of this run; at its end the first one dismisses the others, if it has not called them."""
    if n_started() == 1:
        yield ALONE
        return
    _check(config)
    ranks = _connect(config.device)
    if not ranks.is_first:
        log.setLevel(logging.WARNING)
    try:
        yield ranks
    except BaseException as error:
        if not isinstance(error, LostRankError):
            _store().add("explained", 1)  # the others, which are about to lose this rank, need not say so
        raise
    finally:
        if ranks.is_first and not ranks.has_called:
            with suppress(LostRankError):  # they have ended before
                ranks.call(None)
        ranks.close()


def says(line: str) -> bool:
    """Whether this rank is the one that says a line which all may have to say: the first that asks.

    The others wait until it has had the time: with the first process that ends, `torchrun` ends them all.
    """
    if n_started() == 1:
        return True
    try:
        is_speaker = _store().add(hashlib.sha256(line.encode()).hexdigest(), 1) == 1
    except (RuntimeError, UserError):  # the store is gone with the first rank, or there is no torchrun
        return True
    if not is_speaker:
        time.sleep(EXPLAIN_S)
    return is_speaker


def says_loss() -> bool:
    """Whether this rank is the one that says that another is lost: the first to notice, if no rank explains its end."""
    time.sleep(EXPLAIN_S)
    try:
        return _store().add("explained", 0) == 0 and _store().add("lost", 1) == 1
    except RuntimeError:
        return True


def _own_number() -> int:
    return int(os.environ.get("RANK") or 0)


def _connect(device: str) -> Processes:
    """Connect with the other processes, each with a GPU of its own where there are any."""
    has_gpu = device != "cpu" and torch.cuda.is_available()
    if has_gpu:
        local, n_gpus = int(os.environ.get("LOCAL_RANK") or 0), torch.cuda.device_count()
        if local >= n_gpus:
            raise UserError(f"torchrun --nproc-per-node must be at most {n_gpus}, the GPUs here, got {n_local()}")
        torch.cuda.set_device(local)
    try:
        dist.init_process_group(
            "cpu:gloo,cuda:nccl" if has_gpu else "gloo",
            store=_store(),
            rank=_own_number(),
            world_size=n_started(),
            timeout=PATIENCE,
        )
    except RuntimeError as error:
        reason = abbreviate(" ".join(str(error).split()))
        raise UserError(f"torchrun must start {n_started()} processes that reach each other, got {reason}") from error
    return Processes()


@cache
def _store() -> dist.Store:
    """The store of this start of the processes; `torchrun` keeps it, otherwise the first rank does."""
    try:
        host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    except (KeyError, ValueError) as error:
        raise UserError(f"WORLD_SIZE must be 1 without torchrun, which sets {error}, got {n_started()}") from error
    is_kept = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    is_host = is_first() and not is_kept
    store = dist.TCPStore(host, port, is_master=is_host, timeout=CONNECT, wait_for_workers=False)
    return dist.PrefixStore(f"negopipe/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", store)


def _check(config: "RunConfig") -> None:
    n_worlds = config.algorithm.n_worlds
    if "train" in config.stages and n_worlds < n_started():
        raise UserError(f"algorithm.n_worlds must be at least {n_started()}, one for each process, got {n_worlds}")
