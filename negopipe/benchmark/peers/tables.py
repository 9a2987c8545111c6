"""A comparison as text, JSON and CSV."""

import json
import os
import platform
import re
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table

from negopipe.benchmark.peers.comparison import Comparison, Measured, Ratio
from negopipe.tracking.csv_file import CsvKind, write_csv
from negopipe.tracking.whole_file import write_whole

TABLE = CsvKind(
    "python -m negopipe.benchmark.peers",
    {"peer": str, "own": str, "unit": str, "differs": str, "n_rounds": int, "*": float},
    "%.4g",
)


def show(comparison: Comparison, console: Console) -> None:
    """Print what was measured, the ratios, and what was not measured."""
    rates = Table(title="one thread, CPU time")
    for header in ("", "per s", "p50 ms", "p99 ms", "p99 ms, wall", "import s", "first call s"):
        rates.add_column(header, justify="right" if header else "left")
    for name, one in comparison.measured.items():
        start, figures = one.start, calls(one)
        shown = [figures["p50_ms"], figures["p99_ms"], figures["wall_p99_ms"], start.import_cpu_s, start.first_cpu_s]
        rates.add_row(name, f"{one.rate:,.0f}", *(f"{value:.3g}" for value in shown))
    ratios = Table(title="negopipe as a multiple of the peer, per core")
    for header in ("negopipe", "peer", "median", "range"):
        ratios.add_column(header, justify="left" if header in ("negopipe", "peer") else "right")
    for ratio in comparison.ratios:
        ratios.add_row(ratio.own.name, ratio.peer.name, f"{ratio.median:.3g}", f"{ratio.low:.3g} to {ratio.high:.3g}")
    for table in (rates, ratios):
        if table.row_count:
            console.print(table)
    for peer in {ratio.peer.name: ratio.peer for ratio in comparison.ratios}.values():
        console.print(f"{peer.name}: not the same: {peer.differs}", highlight=False)
    for name, reason in comparison.left_out.items():
        console.print(f"{name}: {reason}", highlight=False)


def calls(measured: Measured) -> dict[str, float]:
    """Durations of single calls, ms: medians over the rounds of their percentiles, CPU and wall time."""
    rounds = pd.DataFrame([asdict(each) for each in measured.rounds]).median()
    names = {"p50_ms": "cpu_p50_ms", "p99_ms": "cpu_p99_ms", "wall_p99_ms": "wall_p99_ms"}
    return {name: float(rounds[column]) for name, column in names.items()}


def write_json(path: Path, comparison: Comparison, n_rounds: int, seconds: float) -> None:
    """Everything that was measured, with the machine and the versions."""
    content: dict[str, Any] = {
        "made": {**machine(), "n_rounds": n_rounds, "seconds": seconds},
        "measured": {
            name: {"start": asdict(one.start), "rounds": [asdict(each) for each in one.rounds]}
            for name, one in comparison.measured.items()
        },
        "ratios": [_row(ratio, comparison.measured) for ratio in comparison.ratios],
        "left_out": dict(comparison.left_out),
    }
    write_whole(path, (json.dumps(content, indent=1) + "\n").encode())


def write_table(path: Path, comparison: Comparison) -> None:
    """A row per ratio."""
    rows = pd.DataFrame([_row(ratio, comparison.measured) for ratio in comparison.ratios])
    write_csv(path, rows, TABLE)


def machine() -> dict[str, Any]:
    """Date, processor, cores and load."""
    described = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*: (.*)$", described.read_text(), flags=re.M) if described.exists() else None
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "processor": found[1] if found else platform.processor(),
        "n_cores": os.cpu_count(),
        "load_1_min": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def _row(ratio: Ratio, measured: Mapping[str, Measured]) -> dict[str, Any]:
    peer, own = measured[ratio.peer.name], measured[ratio.own.name]
    row: dict[str, Any] = {"peer": ratio.peer.name, "own": ratio.own.name, "unit": ratio.peer.unit}
    row |= {"n_rounds": len(peer.rounds), "ratio": ratio.median, "ratio_low": ratio.low, "ratio_high": ratio.high}
    for name, one in (("peer", peer), ("own", own)):
        figures = {"per_s": one.rate, **calls(one)}
        figures |= {"import_s": one.start.import_cpu_s, "first_s": one.start.first_cpu_s}
        row |= {f"{name}_{figure}": value for figure, value in figures.items()}
    return row | {"differs": ratio.peer.differs}
