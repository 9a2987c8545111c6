"""Speed of calls and machines: medians, latencies, memory, and two reference rates of the machine."""

import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator

from negopipe.checks import N_COPIES, Memory, Observed
from negopipe.errors import UserError
from negopipe.peak_memory import peak_memory_bytes
from negopipe.schema import Distinct, PositiveFloat, PositiveInt, schema
from negopipe.tensors.timing import block_seconds
from negopipe.tracking.csv_file import CsvKind, read_csv

Backend = Literal["eager", "compiled", "cuda_eager", "cuda"]

MATRIX_SIDE = 2048
"""Rows and columns of the matrices in the reference product."""

COPY_FLOATS = 2**26
"""Numbers in the reference copy: 256 MiB, larger than any cache."""

RUNTIME = CsvKind("python -m negopipe.deployment.speed", {"export": str, "n_*": int, "*": float})
"""Table of the runtime's speed."""


@schema
class BenchmarkConfig:
    """`conf/benchmark/speed.yaml` says what each value means."""

    backends: Annotated[tuple[Backend, ...], Field(min_length=1), Distinct]
    n_worlds: Annotated[tuple[PositiveInt, ...], Field(min_length=1), Distinct]
    base_n_worlds: PositiveInt
    n_warmups: PositiveInt
    n_repetitions: PositiveInt
    min_time_s: PositiveFloat
    n_latencies: PositiveInt
    n_iterations: PositiveInt
    export: str | None

    @model_validator(mode="after")
    def _has_base(self) -> "BenchmarkConfig":
        if self.base_n_worlds not in self.n_worlds:
            among = ", ".join(map(str, self.n_worlds))
            raise ValueError(f"base_n_worlds must be among n_worlds = {among}, got {self.base_n_worlds}")
        return self

    def memory(self, observed: Observed) -> Memory:
        """Memory of the observations of all worlds."""
        n_bytes = max(self.n_worlds) * observed.n_bytes * N_COPIES
        return Memory("the benchmark", n_bytes, ("benchmark.n_worlds", *observed.keys))


def seconds_per_call(call: Callable[[], Any], config: BenchmarkConfig, device: torch.device) -> float:
    """Duration of a call, s: median over blocks of calls, so that rare work (resets) counts too."""
    for _ in range(config.n_warmups):
        once = block_seconds(call, 1, device)
    n_calls = max(1, round(config.min_time_s / config.n_repetitions / once))
    blocks: list[float] = []
    while len(blocks) < config.n_repetitions or sum(blocks) < config.min_time_s:
        blocks.append(block_seconds(call, n_calls, device))
    return statistics.median(blocks) / n_calls


def latency_percentiles_ms(
    call: Callable[[], Any], config: BenchmarkConfig, device: torch.device
) -> tuple[float, float]:
    """Median and 99th percentile of the durations of single calls, ms."""
    for _ in range(config.n_warmups):
        call()
    latencies = torch.tensor([block_seconds(call, 1, device) for _ in range(config.n_latencies)])
    p50, p99 = (1e3 * latencies.quantile(torch.tensor([0.5, 0.99]))).tolist()
    return p50, p99


def matmul_gflops(config: BenchmarkConfig, device: torch.device) -> float:
    """Rate of a float32 product of two 2048 x 2048 matrices, 1e9 operations/s (a multiply-add is two)."""
    a, b = torch.rand(2, MATRIX_SIDE, MATRIX_SIDE, device=device)
    out = torch.empty_like(a)
    return 2 * MATRIX_SIDE**3 / seconds_per_call(lambda: torch.matmul(a, b, out=out), config, device) / 1e9


def runtime_figures(export: str, n_decisions: int) -> dict[str, float]:
    """Figures of `python -m negopipe.deployment.speed` for an export, in a process without torch."""
    with tempfile.TemporaryDirectory(prefix="negopipe-") as folder:
        table = Path(folder) / "speed.csv"
        command = [sys.executable, "-m", "negopipe.deployment.speed", export]
        command += ["--decisions", str(n_decisions), "--table", str(table)]
        measured = subprocess.run(command, capture_output=True, text=True)
        if measured.returncode:
            last = (measured.stderr.splitlines() or ["no message"])[-1]
            raise UserError(f"benchmark.export must be a folder with the whole decision, got {export}: {last}")
        row = read_csv(table, RUNTIME).iloc[0]
    return {name: float(row[name]) for name in row.index.drop("export")}


def copy_gb_per_s(config: BenchmarkConfig, device: torch.device) -> float:
    """Rate of a large plain copy, 1e9 bytes/s; bytes read and bytes written both count."""
    source = torch.rand(COPY_FLOATS, device=device)
    target = torch.empty_like(source)
    return 2 * 4 * COPY_FLOATS / seconds_per_call(lambda: target.copy_(source), config, device) / 1e9


def peak_memory_mb(device: torch.device) -> float:
    """Peak memory since the start of the process, 1e6 bytes: of the process, or of tensors on a GPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    return peak_memory_bytes() / 1e6
