"""Chaos test: a sweep in parallel processes on one store, whose jobs are killed at random times.

A fifth of the jobs is killed with SIGKILL, twice, and the same command is then given once more. Every job must be
finished exactly once, with the results of an undisturbed sweep.

    python jobs/chaos.py                    # 100 jobs, about 20 minutes on 2 cores
    python jobs/chaos.py --jobs 12 --keep /tmp/chaos

A job is the command line `python -m negopipe +experiment=smoke stages=[train] seed=<n>`, forked from a process that
has imported everything, since a hundred interpreters would spend most of their time on imports. The exit code is 1 if
a check fails.
"""

import argparse
import hashlib
import importlib
import json
import os
import random
import signal
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
SETTINGS = (
    "+experiment=smoke",
    "stages=[train]",
    "n_threads=1",
    "algorithm.n_steps=16",
    "tracking.snapshot_period_s=0.2",
)
DURATIONS = ("wall_s", "decisions_per_s", "tracking_share")


def load_code() -> None:
    """Import everything that a job needs, before the jobs are forked."""
    for module in ("negopipe.stages.train", "negopipe.config.root", "mlflow", "mlflow.store.tracking.sqlalchemy_store"):
        importlib.import_module(module)
    importlib.import_module("sqlalchemy.orm").configure_mappers()


def start(outputs: Path, seed: int) -> int:
    """Fork one command line; returns its process id."""
    child = os.fork()
    if child:
        return child
    log = os.open(outputs / f"seed{seed}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    sys.argv = ["negopipe", *SETTINGS, f"seed={seed}", f"outputs={outputs}"]
    code = 1
    try:
        code = importlib.import_module("negopipe.__main__").main()
    except SystemExit as stop:
        code = int(stop.code or 0)
    finally:
        sys.stdout.flush()
        os._exit(code)


def sweep(outputs: Path, seeds: list[int], n_parallel: int, fates: dict[int, float]) -> tuple[Counter[str], float]:
    """Run the jobs of all seeds.

    fates: seconds after which a job is killed, by its seed
    Returns the numbers of jobs by their end, and the mean duration (s) of a job that succeeded.
    """
    outputs.mkdir(parents=True, exist_ok=True)
    waiting, running, took = list(seeds), dict[int, tuple[int, float]](), list[float]()
    ends: Counter[str] = Counter()
    while waiting or running:
        while waiting and len(running) < n_parallel:
            seed = waiting.pop(0)
            running[start(outputs, seed)] = (seed, time.monotonic())
        for child, (seed, started_s) in list(running.items()):
            age_s = time.monotonic() - started_s
            if age_s >= fates.get(seed, float("inf")):
                os.kill(child, signal.SIGKILL)
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended:
                del running[child]
                code = os.waitstatus_to_exitcode(status)
                ends["killed" if code == -signal.SIGKILL else f"exit code {code}"] += 1
                took += [age_s] if code == 0 else []
        time.sleep(0.01)
        print(f"\r  {sum(ends.values())} of {len(seeds)} jobs over", end="", flush=True)
    print()
    return ends, sum(took) / max(len(took), 1)


def results(outputs: Path) -> dict[str, str]:
    """Hash of the results of each run: weights, learning curve and metrics of the store, without durations."""
    found = {}
    with closing(sqlite3.connect(outputs / "mlflow" / "mlflow.db")) as connection:
        for name, run_id in connection.execute("SELECT name, run_uuid FROM runs").fetchall():
            query = "SELECT key, step, value FROM metrics WHERE run_uuid = ? ORDER BY key, step, value"
            rows = [row for row in connection.execute(query, (run_id,)) if not row[0].endswith(DURATIONS)]
            folder = outputs / "smoke" / name
            weights = (folder / "checkpoint.safetensors").read_bytes() if folder.is_dir() else b""
            train = json.loads((folder / "metrics.json").read_text())["train"]
            scores = {key: value for key, value in train.items() if key not in DURATIONS}
            found[name] = hashlib.sha256(weights + repr((rows, scores)).encode()).hexdigest()
    return found


def statuses(outputs: Path) -> Counter[str]:
    """Number of runs in the store by their status."""
    with closing(sqlite3.connect(outputs / "mlflow" / "mlflow.db")) as connection:
        return Counter(status for (status,) in connection.execute("SELECT status FROM runs"))


def times_finished(outputs: Path) -> Counter[int]:
    """Number of jobs by how often each has finished."""
    journals = (outputs / "smoke").glob("*/journal.jsonl")
    return Counter(journal.read_text().count('"status": "FINISHED"') for journal in journals)


def main(n_jobs: int, killed_share: float, n_parallel: int, folder: Path, seed: int) -> int:
    seeds, generator = list(range(n_jobs)), random.Random(seed)
    print(f"undisturbed: {n_jobs} jobs, {n_parallel} at a time")
    _, mean_s = sweep(folder / "undisturbed", seeds, n_parallel, {})
    outputs, n_killed = folder / "chaos", 0
    victims = generator.sample(seeds, round(killed_share * n_jobs))
    for attempt in (1, 2):
        print(f"disturbed, {attempt}: {len(victims)} jobs to be killed within {mean_s:.1f} s of their start")
        ends, _ = sweep(outputs, seeds, n_parallel, {victim: generator.uniform(0.0, mean_s) for victim in victims})
        n_killed += ends["killed"]
        print(f"  {dict(ends)}; in the store {dict(statuses(outputs))}")
    print("the same command once more")
    ends, _ = sweep(outputs, seeds, n_parallel, {})
    expected, found = results(folder / "undisturbed"), results(outputs)
    checks = {
        "all commands ended well": ends == {"exit code 0": n_jobs},
        "each job is one FINISHED run": statuses(outputs) == {"FINISHED": n_jobs},
        "each job finished exactly once": times_finished(outputs) == {1: n_jobs},
        "results are those of the undisturbed sweep": found == expected and len(found) == n_jobs,
    }
    n_equal = sum(found.get(name) == digest for name, digest in expected.items())
    print(
        f"kills {n_killed}; statuses {dict(statuses(outputs))}; times finished {dict(times_finished(outputs))}; ",
        end="",
    )
    print(f"equal results {n_equal} of {n_jobs}")
    for check, holds in checks.items():
        print(f"  {'yes' if holds else 'NO '}  {check}")
    return 0 if all(checks.values()) else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=100)
    parser.add_argument("--killed", type=float, default=0.2, help="share of the jobs that is killed each time")
    parser.add_argument("--parallel", type=int, default=4, help="jobs at a time")
    parser.add_argument("--keep", type=Path, help="folder for the outputs; without it they are deleted")
    parser.add_argument("--seed", type=int, default=0, help="seed of the kills")
    options = parser.parse_args()
    load_code()
    with tempfile.TemporaryDirectory() as scratch:
        sys.exit(main(options.jobs, options.killed, options.parallel, options.keep or Path(scratch), options.seed))
