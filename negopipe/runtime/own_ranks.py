"""The ranks that a long training of a small network starts by itself, one per core that the run may use.

Threads share the work of a large network. The simulator computes its chunks of worlds one after the other, so where it
takes most of the time, further processes with worlds of their own help more. See docs/scaling.md for what is exact.
"""

import logging
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from negopipe.errors import UserError
from negopipe.game.game import CHUNKS
from negopipe.runtime.ranks import connected, n_started, store
from negopipe.tensors.ranks import LostRankError, Ranks

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

log = logging.getLogger("negopipe")

LONG = 100_000
"""Decisions from which a training is long enough for the start of further processes and their compilation."""
END_S = 20.0
"""Longest wait for the end of another process that has nothing left to do, s."""
MODULE = "negopipe.stages.train"
"""What a further process runs."""
HERE = "here"
"""Key of the store that counts the other processes that have come."""


def number_of(config: "RunConfig") -> int:
    """Ranks that a training starts; none has fewer worlds than a chunk of compiled code."""
    algorithm, stages = config.algorithm, config.curriculum.stages
    n_decisions = sum(stage.n_iterations for stage in stages) * algorithm.n_worlds * algorithm.n_steps
    is_large = config.policy.kind != "objects"
    if n_started() > 1 or config.device != "cpu" or is_large or n_decisions < LONG:
        return 1
    return max(1, min(int(config.n_threads), algorithm.n_worlds // CHUNKS["cpu"][0]))


@contextmanager
def joined(config: "RunConfig", ranks: Ranks) -> Iterator[tuple["RunConfig", Ranks]]:
    """Context with the config and the ranks of a training.

    These are the given ranks, or further processes on this machine, which end with the context; `n_threads` of the
    config is then that of each.
    """
    number = number_of(config)
    if number == 1:
        yield config, ranks
        return
    n_threads, share = torch.get_num_threads(), int(config.n_threads) // number
    log.info(f"ranks      {number} processes train together")
    with _as_first(number):
        others = [_start(index) for index in range(1, number)]
        torch.set_num_threads(share)
        try:
            _await(others)
            with connected(config.device) as together:
                yield replace(config, n_threads=share), together
        finally:
            torch.set_num_threads(n_threads)
            for other in others:
                _end(other)
            store.cache_clear()


def join(follow: Callable[[Ranks], None]) -> int:
    """Train by `follow` as another rank than the first, whose process has started this one; returns the exit status."""
    store().add(HERE, 1)
    try:
        with connected("cpu") as ranks:
            follow(ranks)
    except LostRankError:  # it has been said
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


@contextmanager
def _as_first(number: int) -> Iterator[None]:
    """Context in which the environment says of this process what `torchrun` says of the first one."""
    names = {"RANK": 0, "LOCAL_RANK": 0, "WORLD_SIZE": number, "LOCAL_WORLD_SIZE": number, "MASTER_PORT": _free_port()}
    before = {name: os.environ.get(name) for name in (*names, "MASTER_ADDR")}
    os.environ.update({"MASTER_ADDR": "127.0.0.1"} | {name: str(value) for name, value in names.items()})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start(index: int) -> subprocess.Popen[bytes]:
    quiet = {"TORCH_CPP_LOG_LEVEL": "ERROR"}  # of a process that ends, negopipe says what matters in one line
    environment = {**os.environ, **quiet, "RANK": str(index), "LOCAL_RANK": str(index)}
    return subprocess.Popen([sys.executable, "-m", MODULE], env=environment)


def _await(others: list[subprocess.Popen[bytes]]) -> None:
    """Wait until all have come; UserError where one has ended instead."""
    while store().add(HERE, 0) < len(others):
        if any(other.poll() is not None for other in others):
            raise UserError("n_threads must be 1 where no further process can be started, got one that ended at once")
        time.sleep(0.05)


def _end(other: subprocess.Popen[bytes]) -> None:
    """Wait for the end of a process, or end it."""
    try:
        other.wait(END_S)
    except subprocess.TimeoutExpired:
        other.kill()
        other.wait()


def _free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return int(server.getsockname()[1])
