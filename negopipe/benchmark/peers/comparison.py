"""One run: the installed peers and negopipe take turns, and every round gives a ratio."""

import importlib.util
import logging
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from negopipe.benchmark.peers.catalogue import PYTHON_ROBOTICS, Peer, Workload
from negopipe.benchmark.peers.worker import Round, Start, Worker
from negopipe.errors import UserError

log = logging.getLogger("negopipe")


@dataclass(frozen=True)
class Measured:
    """A workload's start and its rounds."""

    start: Start
    rounds: list[Round]

    @property
    def rate(self) -> float:
        """Units per second of CPU time: the median of the rounds."""
        return median(each.per_cpu_s for each in self.rounds)


@dataclass(frozen=True)
class Ratio:
    """negopipe's rate over a peer's: median, lowest and highest of the rounds."""

    own: Workload
    peer: Peer
    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Comparison:
    """measured: by name of the workload; left_out: why a peer was not measured, by its name."""

    measured: Mapping[str, Measured]
    ratios: Sequence[Ratio]
    left_out: Mapping[str, str]


def python_of(peer: Peer, environments: Path) -> str | None:
    """Interpreter that has a peer: of its own environment, else this one; None where it is not installed."""
    own = environments / peer.environment / "bin" / "python"
    if own.exists():
        return str(own.absolute())  # not resolved: a link of a virtual environment leads out of it
    return sys.executable if importlib.util.find_spec(peer.module) else None


def compare(
    owns: Iterable[Workload],
    peers: Iterable[Peer],
    environments: Path,
    n_rounds: int,
    seconds: float,
    keep: Callable[[Comparison], None] = lambda _: None,
) -> Comparison:
    """Measure peers and what they are compared with, those with the same unit and partners side by side.

    seconds: CPU time of a round
    keep: called with what there is after every group, since a later one may be interrupted

    A peer that is not installed, or fails, is left out and told. UserError where a workload of negopipe fails.
    """
    by_name = {own.name: own for own in owns}
    measured: dict[str, Measured] = {}
    ratios: list[Ratio] = []
    left_out: dict[str, str] = {}
    for partners, group in _groups(peers).items():
        installed = _installed(group, environments, left_out)
        if installed:
            found = _side_by_side([by_name[name] for name in partners], installed, n_rounds, seconds, left_out)
            ratios += _ratios([by_name[name] for name in partners], group, found)
            measured |= found
            keep(Comparison(measured, ratios, left_out))
    return Comparison(measured, ratios, left_out)


def _groups(peers: Iterable[Peer]) -> dict[tuple[str, ...], list[Peer]]:
    """Peers by what they are compared with."""
    groups: dict[tuple[str, ...], list[Peer]] = {}
    for peer in peers:
        groups.setdefault(peer.beside, []).append(peer)
    return groups


def _installed(peers: Iterable[Peer], environments: Path, left_out: dict[str, str]) -> dict[str, tuple[Peer, str]]:
    """The installed ones with their interpreters, by name."""
    found = {}
    for peer in peers:
        python = python_of(peer, environments)
        if peer.file == PYTHON_ROBOTICS and not peer.options:
            left_out[peer.name] = "not measured: --python-robotics <folder of a checkout> is needed"
        elif python is None:
            left_out[peer.name] = f"not installed: no {peer.environment} in {environments}"
        else:
            found[peer.name] = (peer, python)
        if peer.name in left_out:
            log.info(f"{peer.name}: {left_out[peer.name]}")
    return found


def _side_by_side(
    owns: Iterable[Workload],
    peers: Mapping[str, tuple[Peer, str]],
    n_rounds: int,
    seconds: float,
    left_out: dict[str, str],
) -> dict[str, Measured]:
    """Rounds in which every workload has a turn, so that a slow moment of the machine affects all of them."""
    with ExitStack() as stack:
        workers: dict[str, Worker] = {}
        for name, (peer, python) in peers.items():
            try:
                workers[name] = _started(stack, peer, python)
            except UserError as error:
                _leave_out(left_out, name, error)
        for own in owns if workers else ():
            workers[own.name] = _started(stack, own, sys.executable)
        rounds: dict[str, list[Round]] = {name: [] for name in workers}
        for number in range(n_rounds):
            log.info(f"round {number + 1} of {n_rounds}: {'; '.join(workers)}")
            for name in list(workers):
                try:
                    rounds[name].append(workers[name].measure(seconds))
                except UserError as error:
                    if name not in peers:
                        raise
                    _leave_out(left_out, name, error)
                    del workers[name]
        return {name: Measured(worker.start, rounds[name]) for name, worker in workers.items()}


def _leave_out(left_out: dict[str, str], name: str, error: UserError) -> None:
    left_out[name] = f"fails: {error}"
    log.info(f"{name}: {left_out[name]}")


def _started(stack: ExitStack, workload: Workload, python: str) -> Worker:
    log.info(f"start {workload.name}")
    worker = Worker(python, workload.path, workload.options)
    stack.callback(worker.close)
    return worker


def _ratios(owns: Iterable[Workload], peers: Iterable[Peer], measured: Mapping[str, Measured]) -> list[Ratio]:
    ratios = []
    for peer in (peer for peer in peers if peer.name in measured):
        for own in owns:
            pairs = zip(measured[own.name].rounds, measured[peer.name].rounds, strict=True)
            values = [mine.per_cpu_s / theirs.per_cpu_s for mine, theirs in pairs]
            ratios.append(Ratio(own, peer, median(values), min(values), max(values)))
    return ratios
