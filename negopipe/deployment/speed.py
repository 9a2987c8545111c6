"""Time and memory of the runtime on this machine: `python -m negopipe.deployment.speed <folder> [...]`.

An ego drives its plans along a street with parked cars while another car comes towards it. What is measured is all of
`Negotiator.decide`, on one thread. With --table the figures become a row of a CSV file, written once all is measured.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from negopipe.deployment import EgoState, HostStreet, Negotiator, ObjectState
from negopipe.deployment.open_decision import FILES, Backend
from negopipe.errors import UserError
from negopipe.peak_memory import peak_memory_bytes

COMMAND = "python -m negopipe.deployment.speed"
N_WARM_UP = 20
"""Decisions that are not measured."""


@dataclass(frozen=True)
class Speed:
    """Figures of one export.

    n_decisions: measured; p50_ms, p99_ms: CPU time of a decision; p99_wall_ms: time by the clock, other processes'
        work included
    memory_mb: largest resident memory of the process, 2^20 bytes
    import_s, load_s: times by the clock to import the runtime and the backend, and to load an export
    load: processes that ran or waited to run on this machine, in the mean of the last minute
    """

    n_decisions: int
    p50_ms: float
    p99_ms: float
    p99_wall_ms: float
    memory_mb: float
    import_s: float
    load_s: float
    load: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 1 after a line that says what is wrong."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the export")
    parser.add_argument("--decisions", type=int, default=500, help="number of decisions (default: 500)")
    parser.add_argument("--backend", choices=FILES, default="onnxruntime", help="what decides (default: onnxruntime)")
    parser.add_argument("--table", type=Path, help="CSV file that gets a row; one of the same export is replaced")
    given = parser.parse_args(arguments)
    try:
        speed = measure(given.folder, given.decisions, given.backend)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    for field in fields(speed):
        print(f"{field.name:12} {getattr(speed, field.name):.4g}")
    if given.table is not None:
        _add_row(given.table, given.folder, given.backend, speed)
    return 0


def measure(folder: Path, n_decisions: int, backend: Backend = "onnxruntime") -> Speed:
    """Load an export and decide."""
    began = time.perf_counter()
    negotiator = Negotiator.load(folder, backend=backend)
    load_s = time.perf_counter() - began
    x = np.linspace(-60.0, 60.0, 121)
    left, right = (np.column_stack([x, np.full_like(x, y)]) for y in (3.5, -3.5))
    parked = np.array([[at, y, 0.0, 3.6, 1.9] for at in (-4.2, 0.0, 4.2) for y in (2.55, -2.55)])
    seconds = _drive(negotiator, negotiator.street_between(left, right, parked), n_decisions + N_WARM_UP)
    (p50, p99), (_, p99_wall) = (np.percentile(each, [50, 99]) * 1e3 for each in seconds[N_WARM_UP:].T)
    memory_mb = peak_memory_bytes() / 2**20
    load = Path("/proc/loadavg").read_text(encoding="utf-8").split()[0]
    times = (float(p50), float(p99), float(p99_wall))
    return Speed(n_decisions, *times, memory_mb, _import_s(backend), load_s, float(load))


def _import_s(backend: Backend) -> float:
    """Time of the imports in a process of its own, s."""
    code = f"import time; began = time.perf_counter(); import {backend}; from negopipe.deployment import Negotiator"
    code += "; print(time.perf_counter() - began)"
    return float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)


def _drive(negotiator: Negotiator, street: HostStreet, n_decisions: int) -> np.ndarray:
    """[n, 2] s: CPU time and time by the clock of each decision; the drive begins anew every 10 s."""
    dt_s, times = negotiator.settings.dt_s, []
    state = np.zeros(6)
    for step in range(n_decisions):
        time_s, in_drive_s = step * dt_s, (step * dt_s) % 10
        if in_drive_s < dt_s / 2:
            state = np.array([-30.0, -1.75, 0.0, 4.8, 0.0, 0.0])
        ego = EgoState(*[time_s, *state, 6.0])
        car = ObjectState("car", time_s, 30.0 - 5.0 * in_drive_s, 1.75, np.pi, 5.0, length=4.5, width=1.8)
        began = time.thread_time(), time.perf_counter()
        plan = negotiator.decide(ego, [car], street, time_s)
        times.append((time.thread_time() - began[0], time.perf_counter() - began[1]))
        state = plan.at(time_s + dt_s)
    return np.array(times)


def _add_row(path: Path, folder: Path, backend: str, speed: Speed) -> None:
    """Write a row into a table, in the place of one of the same export."""
    from negopipe.deployment.parity_table import put_row, row_name
    from negopipe.tracking.csv_file import CsvKind

    put_row(
        path,
        CsvKind(COMMAND, {"export": str, "n_*": int, "*": float}, "%.3g"),
        row_name(folder, backend),
        asdict(speed),
    )


if __name__ == "__main__":
    sys.exit(main())
