"""Processes of torchrun train as one process does, and a killed one ends them all with one line, to be resumed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
import torch
import torch.distributed as dist
from safetensors.torch import load_file

from negopipe.runtime import ranks

DURATIONS = ["wall_s", "decisions_per_s", "collectives_s"]
TRAIN = (
    "+experiment=smoke",
    "stages=[train]",
    "device=cpu",
    "n_threads=1",
    "policy=objects",
    "observation=objects",
    "algorithm.n_worlds=8",
    "scenario.episode_steps=12",
    "tracking.snapshot_period_s=0.1",
)
LONG = "curriculum.stages=[{name: only, n_iterations: 60, families: ${scenario.families}}]"
ROUNDING = 2e-5
"""As in tests/training/test_training_in_ranks.py."""


def start(number: int, outputs: Path, *overrides: str) -> subprocess.Popen[str]:
    """Start so many ranks; each writes what it says to a file of its own in `outputs/<attempt>/<rank>`."""
    launcher = [sys.executable, "-m", "torch.distributed.run", f"--nproc-per-node={number}", "--log-dir", str(outputs)]
    command = [*launcher, "--redirects", "3", "-m", "negopipe", *TRAIN, f"outputs={outputs}", *overrides]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def finish(number: int, outputs: Path, *overrides: str) -> tuple[bytes, pd.DataFrame]:
    process = start(number, outputs, *overrides)
    _, said = process.communicate(timeout=400)
    assert process.returncode == 0, said
    folder = folder_of(outputs)
    history = pd.read_csv(folder / "history.csv").drop(columns=DURATIONS, errors="ignore")
    return (folder / "checkpoint.safetensors").read_bytes(), history


def folder_of(outputs: Path) -> Path:
    (folder,) = (outputs / "smoke").glob("seed*")
    return folder


def newest_snapshot(outputs: Path) -> str:
    """Name of the newest snapshot; empty where there is none."""
    return max((path.stem for path in outputs.glob("smoke/*/snapshots/*")), default="")


def ranks_of(process: subprocess.Popen[str]) -> dict[int, int]:
    """Process ids of the ranks that torchrun has started, by rank."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    entries = {int(pid): Path(f"/proc/{pid}/environ").read_bytes().split(b"\0") for pid in children}
    return {int(e[5:]): pid for pid, each in entries.items() for e in each if e.startswith(b"RANK=")}


def lines_of_errors(outputs: Path) -> list[str]:
    """What the ranks of the latest start have written to stderr."""
    latest = max(outputs.glob("*_*"), key=lambda path: path.stat().st_mtime)
    return [line for path in latest.rglob("stderr.log") for line in path.read_text().splitlines()]


@pytest.mark.slow
def test_processes_train_as_one_process_does(tmp_path: Path) -> None:
    weights = {}
    for number in (1, 2, 4):
        _, history = finish(number, tmp_path / f"{number}")
        weights[number] = load_file(folder_of(tmp_path / f"{number}") / "checkpoint.safetensors")
        episodes = (folder_of(tmp_path / f"{number}") / "training_episodes.csv").read_bytes()
        assert episodes == (folder_of(tmp_path / "1") / "training_episodes.csv").read_bytes()
        assert len(history) == 6
    for number in (2, 4):
        for name, weight in weights[1].items():
            torch.testing.assert_close(weights[number][name], weight, atol=ROUNDING, rtol=ROUNDING)


@pytest.mark.slow
def test_a_killed_rank_ends_the_run_with_one_line_and_the_same_command_resumes_it(tmp_path: Path) -> None:
    expected = finish(2, tmp_path / "undisturbed", LONG)
    outputs = tmp_path / "killed"
    for victim in (1, 0):
        before = newest_snapshot(outputs)
        process = start(2, outputs, LONG)
        while newest_snapshot(outputs) <= before:
            assert process.poll() is None, lines_of_errors(outputs)
            time.sleep(0.05)
        os.kill(ranks_of(process)[victim], signal.SIGKILL)
        killed_s = time.monotonic()
        process.communicate(timeout=120)
        assert time.monotonic() - killed_s < 60  # seconds, on a machine that has other work
        assert process.returncode == 1
        (line,) = lines_of_errors(outputs)
        assert line.startswith("one of 2 ranks has ended")
        assert "resumes the run from its newest snapshot" in line
    checkpoint, history = finish(2, outputs, LONG)
    assert checkpoint == expected[0]
    pd.testing.assert_frame_equal(history, expected[1], check_exact=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (("algorithm.n_worlds=1",), "algorithm.n_worlds must be at least 2, one for each process, got 1"),
        (("seed=-1",), "seed must be"),
        (("seeed=1",), "seeed"),
        (("--multirun",), "torchrun must run one config, without -m or --multirun, got 2 processes"),
    ],
)
def test_what_is_wrong_for_all_ranks_is_said_once(tmp_path: Path, overrides: tuple[str, ...], line: str) -> None:
    process = start(2, tmp_path, *overrides)
    process.communicate(timeout=120)
    assert process.returncode == 1
    (said,) = lines_of_errors(tmp_path)
    assert line in said


def test_without_torchrun_there_is_one_rank_that_says_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert ranks.n_started() == ranks.n_local() == 1
    assert ranks.is_first()
    assert ranks.says("a line")


def test_who_leaves_a_line_to_another_gives_it_the_time_to_say_it(monkeypatch: pytest.MonkeyPatch) -> None:
    store, waits = dist.HashStore(), list[float]()
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr(ranks, "_store", lambda: store)
    monkeypatch.setattr(time, "sleep", waits.append)
    assert ranks.says("a line")
    assert waits == []
    assert not ranks.says("a line")
    assert waits == [ranks.EXPLAIN_S]
    assert ranks.says("another line")
