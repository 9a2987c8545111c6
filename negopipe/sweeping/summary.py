"""What came of a sweep, by one command: `python -m negopipe.sweeping.summary outputs/yield`.

A table of all runs of a name, the best config first and ready to paste, summary.csv and a figure in
`outputs/sweeps/<name>/`. It reads run folders and needs no store.
"""

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from negopipe.errors import UserError
from negopipe.report.figures import render
from negopipe.sweeping.parallel_coordinates import parallel_coordinates
from negopipe.sweeping.swept_runs import (
    OBJECTIVE,
    RUNS,
    SEEDS,
    SPREAD,
    STATUS,
    SweptRun,
    differing_keys,
    read_runs,
    tabulate,
)
from negopipe.tracking.csv_file import CsvKind, write_csv
from negopipe.tracking.names import without_implied
from negopipe.tracking.record import as_command

TABLE_NAME, FIGURE_NAME = "summary.csv", "parallel_coordinates"
SUMMARY = CsvKind("negopipe.sweeping.summary", {OBJECTIVE: float, SPREAD: float, SEEDS: int, "*": str})
"""summary.csv: a row per config, columns for the keys that differ and for what came of them."""
N_SHOWN = 40
"""Rows of the table that are shown; summary.csv has all, and all keys that differ."""
N_AXES = 10


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 1 after a line that says what is wrong."""
    parser = argparse.ArgumentParser(prog="python -m negopipe.sweeping.summary", description=__doc__)
    parser.add_argument("folder", type=Path, help="outputs/<name>: the folder that holds the runs")
    parser.add_argument("--sweep", help="only runs with this tag `sweep`")
    parser.add_argument("--objective", nargs="+", metavar="KEY", help="of metrics.json; without it, the runs' own")
    parser.add_argument("--minimize", action="store_true", help="the smallest objective is the best")
    given = parser.parse_args(arguments)
    try:
        summarize(given.folder, given.sweep, given.objective, given.minimize)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def summarize(folder: Path, sweep: str | None, objective: list[str] | None, minimize: bool) -> None:
    """Print the table and the best config, write summary.csv and the figure."""
    runs = read_runs(folder, sweep)
    keys = objective or _own_objective(runs)
    table, differing = tabulate(runs, keys, minimize), differing_keys(runs)
    shown = without_implied(differing, [run.config for run in runs])
    target = folder.parent / "sweeps" / (sweep or folder.name)
    target.mkdir(parents=True, exist_ok=True)
    write_csv(target / TABLE_NAME, table, SUMMARY)
    _show(table, shown, keys)
    print(f"table      {target / TABLE_NAME}")
    if not table[OBJECTIVE].notna().any():
        print(f"best       none: no run has all of {', '.join(keys)}")
        return
    if differing:
        figure = parallel_coordinates(table, shown[:N_AXES], OBJECTIVE, minimize)
        for kind in ("png", "svg"):
            (target / f"{FIGURE_NAME}.{kind}").write_bytes(render(figure, kind))
        left_out = f" (without {', '.join(shown[N_AXES:])})" if shown[N_AXES:] else ""
        print(f"figure     {target / FIGURE_NAME}.png{left_out}")
    name = table.iloc[0][RUNS].split()[0]
    best = next(run for run in runs if run.name == name)
    hint = "" if best.commands else " (add its experiment: the command is not recorded)"
    print(f"best       {folder / name}{hint}\n\n  {paste(best, differing)}\n")


def paste(run: SweptRun, differing: Sequence[str]) -> str:
    """The command that makes the run's results, without its seed; several lines where it took several.

    Where it is not recorded it is made of the keys that differ, and the experiment has to be added by hand.
    """
    from_config = tuple(f"{key}={_override_text(run.config.get(key))}" for key in differing)
    commands = [[text for text in texts if not _is_seed(text)] for texts in run.commands or [from_config]]
    return "\n  ".join(dict.fromkeys(as_command(shlex.join(texts)) for texts in commands))


def _is_seed(override: str) -> bool:
    return override.lstrip("+").startswith("seed=")


def _own_objective(runs: list[SweptRun]) -> list[str]:
    """What the runs' configs say, which is flat here but for a list."""
    found = next((run.config["objective"] for run in runs if run.config.get("objective")), None)
    if found is None:
        raise UserError("--objective must be given, the config of no run has one")
    return list(found)


def _show(table: pd.DataFrame, shown: Sequence[str], keys: Sequence[str]) -> None:
    view = Table(caption=f"objective: mean of {', '.join(keys)}" if len(keys) > 1 else f"objective: {keys[0]}")
    view.add_column("", justify="right")
    for key in shown:
        view.add_column(_header(key), overflow="fold")
    for name in (OBJECTIVE, "spread", SEEDS):
        view.add_column(name, justify="right")
    view.add_column(STATUS)
    for place, row in enumerate(table.head(N_SHOWN).to_dict("records"), start=1):
        values = [_cell(row[key]) for key in shown]
        numbers = [_cell(row[OBJECTIVE]), _cell(row[SPREAD]), str(row[SEEDS])]
        view.add_row(str(place), *map(escape, values), *numbers, row[STATUS])
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)
    console.print(view)
    if len(table) > N_SHOWN:
        print(f"... and {len(table) - N_SHOWN} more")


def _header(key: str) -> str:
    group, dot, name = key.rpartition(".")
    return f"{group}{dot}\n{name}" if group else name


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and pd.isna(value)):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else _override_text(value)


def _override_text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


if __name__ == "__main__":
    sys.exit(main())
