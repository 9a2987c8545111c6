"""Time that ranks spend in collectives, measured here, and a model of what many ranks would do.

    torchrun --nproc-per-node 2 jobs/ranks_speed.py measure <table.csv>     # appends rows; also with 1 and 4 processes
    python jobs/ranks_speed.py model <table.csv> <model.csv>

`measure` trains `+experiment=yield` for a few iterations without a run folder, and times single collectives. More
overrides may follow the table. `model` computes from the rows of one process, and from the messages that the rows of
several processes count, the time of an iteration on networks that it assumes (`NETWORKS`).
"""

import argparse
import math
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from negopipe import load_config
from negopipe.config.root import RunConfig
from negopipe.learning.kfac import Kfac
from negopipe.runtime import backend
from negopipe.runtime.ranks import connected
from negopipe.tensors.ranks import ConnectedRanks, Ranks
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv
from negopipe.training.training import Training

SETTINGS = (
    "+experiment=yield",
    "device=cpu",
    "n_threads=1",
    "policy.precision=float32",
    "policy.memory_format=channels_last",
)
N_WARM, N_TIMED = 2, 8
"""Iterations before the timed ones, the first of which compiles, and timed ones: 16 updates, with one inversion."""
SIZES = (8, 2**10, 2**14, 2**18, 2**20, 2**22, 2**23)
"""Bytes of the timed collectives."""
N_CALLS = 30
"""Timed calls of a collective."""
ALL_REDUCE, ALL_GATHER = "_add_up", "_gather"
"""Names of the collectives of an iteration, those of `ConnectedRanks`."""
MEASURED = CsvKind(
    "jobs/ranks_speed.py measure",
    {"n_ranks": int, "what": str, "name": str, "bytes": float, "number": float, "median": float, "p90": float},
    "%.9g",
)
MODELLED = CsvKind("jobs/ranks_speed.py model", {"network": str, "scaling": str, "n_ranks": int, "*": float})


class Network(NamedTuple):
    """An assumed network: time of a message between two ranks, s, and bytes that a rank sends in a second."""

    latency_s: float
    bytes_per_s: float


NETWORKS = {"10 Gbit Ethernet": Network(50e-6, 1.0e9), "100 Gbit InfiniBand": Network(5e-6, 10e9)}
MANY = (1, 8, 64, 512)
N_WORLDS = 128
"""Worlds of the measured training, of which every rank needs one."""


class Messages:
    """Bytes of all messages of the ranks, by collective, as (bytes, seconds)."""

    def __init__(self, ranks: Ranks) -> None:
        self.sent: dict[str, list[tuple[int, float]]] = defaultdict(list)
        if isinstance(ranks, ConnectedRanks):
            self._timed, ranks._timed = ranks._timed, self._count  # type: ignore[method-assign]

    def _count(self, collective: Callable[[Tensor], Any], tensor: Tensor) -> Any:
        started_s = time.monotonic()
        result = self._timed(collective, tensor)
        self.sent[collective.__name__].append((tensor.nbytes, time.monotonic() - started_s))
        return result


def measure(ranks: Ranks, config: RunConfig) -> list[tuple]:
    """Rows of the table: times of an iteration, its messages, and times of single collectives."""
    inverting = _timed_inversion()
    messages = Messages(ranks)
    training = Training(config, None, ranks)
    for _ in range(N_WARM):
        training.iterate()
    messages.sent.clear()
    times: dict[str, list[float]] = defaultdict(list)
    for _ in range(N_TIMED):
        started_s, cpu_s, waited_s, inverted_s = time.monotonic(), time.process_time(), ranks.seconds, inverting[0]
        training.iterate()
        times["wall_s"].append(time.monotonic() - started_s)
        times["cpu_s"].append(time.process_time() - cpu_s)
        times["collectives_s"].append(ranks.seconds - waited_s)
        times["inversion_cpu_s"].append(inverting[0] - inverted_s)
    inverted_s = statistics.mean(times.pop("inversion_cpu_s"))  # most iterations have none
    n_weights = sum(weight.numel() for weight in training.policy.parameters())
    rows: list[tuple] = [
        (ranks.number, "iteration", name, "", N_TIMED, *_spread(values)) for name, values in times.items()
    ]
    rows.append((ranks.number, "iteration", "mean_inversion_cpu_s", "", N_TIMED, f"{inverted_s:.6g}", ""))
    rows.append((ranks.number, "iteration", "weights", 4 * n_weights, 1, "", ""))
    for name, sent in messages.sent.items():
        by_size: dict[int, list[float]] = defaultdict(list)
        for n_bytes, seconds in sent:
            by_size[n_bytes].append(seconds)
        rows += [
            (ranks.number, "messages", name, n_bytes, len(seconds) / N_TIMED, *_spread(seconds))
            for n_bytes, seconds in sorted(by_size.items())
        ]
    return rows + (_single_collectives(ranks) if isinstance(ranks, ConnectedRanks) else [])


def _single_collectives(ranks: ConnectedRanks) -> list[tuple]:
    """Times of collectives that all ranks begin together, so that nobody waits for another's work."""
    rows = []
    for name in (ALL_REDUCE, ALL_GATHER):
        for n_bytes in SIZES:
            tensor, seconds = torch.zeros(n_bytes // 4 or 1), []
            for _ in range(N_CALLS):
                ranks.each(0)
                started_s = time.monotonic()
                getattr(ranks, name)(tensor)
                seconds.append(time.monotonic() - started_s)
            rows.append((ranks.number, "alone", name, n_bytes, N_CALLS, *_spread(seconds)))
    return rows


def _timed_inversion() -> list[float]:
    """CPU time of the inversions of the Fisher factors so far, s, in a list of one number."""
    seconds, invert = [0.0], Kfac._invert

    def timed(kfac: Kfac) -> None:
        started_s = time.process_time()
        invert(kfac)
        seconds[0] += time.process_time() - started_s

    Kfac._invert = timed  # type: ignore[method-assign,assignment]
    return seconds


def _spread(values: list[float]) -> tuple[float, float]:
    """Median and 90th percentile."""
    p90 = sorted(values)[min(len(values) - 1, math.ceil(0.9 * len(values)) - 1)]
    return statistics.median(values), p90


def append(path: Path, rows: list[tuple]) -> None:
    """Add rows to a table, which may not be there yet."""
    new = pd.DataFrame(rows, columns=[*MEASURED.columns])
    numbers = [name for name, kind in MEASURED.columns.items() if kind is float]
    new[numbers] = new[numbers].apply(pd.to_numeric)  # an empty text is NaN
    write_csv(path, pd.concat([read_csv(path, MEASURED), new]) if path.exists() else new, MEASURED)


def all_reduce_s(n_bytes: float, n: int, network: Network) -> float:
    """A ring: every rank sends 2 (n - 1) / n of the bytes, in 2 (n - 1) messages, or a tree where that is faster."""
    if n == 1:
        return 0.0
    ring = 2 * (n - 1) * network.latency_s + 2 * (n - 1) / n * n_bytes / network.bytes_per_s
    tree = 2 * math.ceil(math.log2(n)) * (network.latency_s + n_bytes / network.bytes_per_s)
    return min(ring, tree)


def all_gather_s(n_bytes: float, n: int, network: Network) -> float:
    """Every rank receives the bytes of all others, in ceil(log2 n) rounds."""
    if n == 1:
        return 0.0
    return math.ceil(math.log2(n)) * network.latency_s + (n - 1) * n_bytes / network.bytes_per_s


def model(table: pd.DataFrame) -> list[dict]:
    """Rows of the model: seconds of an iteration by number of ranks, network and scaling.

    strong: the worlds of the run are shared by the ranks; weak: every rank has as many worlds as the run
    """
    alone = table[(table["n_ranks"] == 1) & (table["what"] == "iteration")].set_index("name")["median"]
    serial_s = alone["mean_inversion_cpu_s"]  # CPU times, which other work on the machine disturbs least
    shared_s = alone["cpu_s"] - serial_s
    sent = table[(table["n_ranks"] == 2) & (table["what"] == "messages")].to_dict("records")
    rows = []
    for name, network in NETWORKS.items():
        for scaling in ("strong", "weak"):
            for n in MANY:
                if scaling == "strong" and n > N_WORLDS:
                    continue
                compute_s = serial_s + (shared_s / n if scaling == "strong" else shared_s)
                in_collectives_s = sum(
                    each["number"] * _message_s(each["name"], each["bytes"], n, network, scaling) for each in sent
                )
                total_s = compute_s + in_collectives_s
                n_times = alone["cpu_s"] * (n if scaling == "weak" else 1) / total_s
                rows.append(
                    {
                        "network": name,
                        "scaling": scaling,
                        "n_ranks": n,
                        "compute_s": round(compute_s, 4),
                        "collectives_s": round(in_collectives_s, 4),
                        "collectives_share": round(in_collectives_s / total_s, 3),
                        "times_faster": round(n_times, 2),
                    }
                )
    return rows


def _message_s(name: str, n_bytes: int, n: int, network: Network, scaling: str) -> float:
    """Time of a message of two ranks' training, among n ranks; what is gathered was half of the worlds' numbers."""
    if name == ALL_REDUCE:
        return all_reduce_s(n_bytes, n, network)
    own = n_bytes if n_bytes <= 8 else n_bytes * (2 / n if scaling == "strong" else 2)
    return all_gather_s(own, n, network)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("measure", "model"))
    parser.add_argument("table", type=Path)
    parser.add_argument("more", nargs="*", help="of measure: overrides; of model: the file of its rows")
    given = parser.parse_args()
    if given.what == "model":
        write_csv(Path(given.more[0]), pd.DataFrame(model(read_csv(given.table, MEASURED))), MODELLED)
        return
    config = load_config(*SETTINGS, *given.more)
    with connected(config) as ranks:
        backend.prepare(config)
        rows = measure(ranks, config)
        if ranks.is_first:
            append(given.table, rows)
        ranks.call(None)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
