"""A training that is killed at any moment ends with the same bytes. NEGOPIPE_KILLS sets how often it is killed, and
the other algorithms a quarter as often."""

import os
import random
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pandas as pd
import pytest

N_KILLS = int(os.environ.get("NEGOPIPE_KILLS") or "20")
LONGEST_S = 20.0
TRAIN = (
    "+experiment=smoke",
    "stages=[train]",
    "n_threads=1",
    "tracking.snapshot_period_s=0.1",
    "tracking.n_metrics_per_flush=7",
)


def start(outputs: Path, algorithm: str) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-m",
        "negopipe",
        *TRAIN,
        f"algorithm={algorithm}",
        "algorithm.n_steps=32",
        f"outputs={outputs}",
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def result(outputs: Path) -> tuple[bytes, str, list[tuple]]:
    """Checkpoint, history and the store's metrics, all without durations."""
    (folder,) = (outputs / "smoke").iterdir()
    history = pd.read_csv(folder / "history.csv").drop(columns=["wall_s", "decisions_per_s"])
    with closing(sqlite3.connect(outputs / "mlflow" / "mlflow.db")) as connection:
        assert connection.execute("SELECT status FROM runs").fetchall() == [("FINISHED",)]
        query = "SELECT key, step, value FROM metrics WHERE key NOT IN ('train/wall_s', 'train/decisions_per_s')"
        stored = connection.execute(f"{query} ORDER BY key, step").fetchall()
    return (folder / "checkpoint.safetensors").read_bytes(), history.to_csv(), stored


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "most"), [("acktr", N_KILLS), *((other, N_KILLS // 4) for other in ("acktr_adam", "a2c", "ppo"))]
)
def test_killed_at_random_times_it_ends_with_the_same_bytes(tmp_path: Path, algorithm: str, most: int) -> None:
    undisturbed = start(tmp_path / "undisturbed", algorithm)
    _, said = undisturbed.communicate(timeout=300)
    assert undisturbed.returncode == 0, said
    expected = result(tmp_path / "undisturbed")
    moments, n_kills, n_runs = random.Random(0), 0, 0
    while n_kills < most:
        n_runs += 1
        outputs = tmp_path / f"killed{n_runs}"
        while True:
            process = start(outputs, algorithm)
            try:
                _, said = process.communicate(timeout=moments.uniform(0.5, LONGEST_S) if n_kills < most else 300)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
                n_kills += 1
                continue
            assert process.returncode == 0, said
            break
        assert result(outputs) == expected
