"""Speed of the environments, for people who choose one: decisions per second of every way to step worlds.

    python jobs/environments.py --decisions 48 --out jobs/results/environments.csv

Random actions, new tasks included, one thread of torch per process. The ways take turns, a short piece of each in each
round, so that other work on the machine slows all of them alike. Ratios say more than the figures themselves. Columns:
    way, n_envs    how gymnasium steps worlds, and how many
    observation    grids or objects
    decisions_per_s  median over the rounds, of all worlds together
    times_single   the same as a multiple of the single environment's
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium
import numpy as np
import pandas as pd

import negopipe
from negopipe.tracking.csv_file import CsvKind, write_csv

WAYS = (("single", 1), ("sync", 8), ("async", 2), ("batched", 8), ("batched", 64))
MODES = {"sync": "sync", "async": "async", "batched": "vector_entry_point"}
KINDS: dict[str, list[str]] = {"grids": [], "objects": ["observation=objects", "policy=objects"]}
N_ROUNDS = 3
COLUMNS = {"way": str, "n_envs": int, "observation": str, "decisions_per_s": float, "times_single": float}
TABLE = CsvKind("jobs/environments.py", COLUMNS)


def made(way: str, n_envs: int, kind: str) -> Any:
    """Worlds of one way, at the start of their tasks."""
    if way == "single":
        envs: Any = negopipe.make_env(KINDS[kind])
    else:
        envs = gymnasium.make_vec(
            "negopipe/NarrowLane-v0", num_envs=n_envs, vectorization_mode=MODES[way], overrides=KINDS[kind]
        )
    envs.reset(seed=1)
    return envs


def seconds(envs: Any, n_steps: int) -> float:
    """Time of some steps with random actions."""
    begin = time.perf_counter()
    for _ in range(n_steps):
        *_, terminated, truncated, _ = envs.step(envs.action_space.sample())
        if np.ndim(terminated) == 0 and (terminated or truncated):
            envs.reset()
    return time.perf_counter() - begin


def measured(kind: str, n_decisions: int, ways: Sequence[tuple[str, int]]) -> pd.DataFrame:
    """A row per way."""
    all_envs = {(way, n): made(way, n, kind) for way, n in ways}
    rates: dict[tuple[str, int], list[float]] = {key: [] for key in all_envs}
    for _ in range(N_ROUNDS):
        for (way, n), envs in all_envs.items():
            n_steps = max(1, n_decisions // (n * N_ROUNDS))
            rates[way, n].append(n * n_steps / seconds(envs, n_steps))
    for envs in all_envs.values():
        envs.close()
    single = median(rates["single", 1])
    rows = [[way, n, kind, round(median(each), 1), round(median(each) / single, 2)] for (way, n), each in rates.items()]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def main(n_decisions: int, out: Path, ways: Sequence[tuple[str, int]] = WAYS) -> None:
    """Measure both observations and write the table; ways: the single one first."""
    tables = [measured(kind, n_decisions, ways) for kind in KINDS]
    write_csv(out, pd.concat(tables, ignore_index=True), TABLE)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--decisions", type=int, required=True, help="decisions per way")
    parser.add_argument("--out", type=Path, required=True, help="file of the table")
    given = parser.parse_args()
    main(given.decisions, given.out)
