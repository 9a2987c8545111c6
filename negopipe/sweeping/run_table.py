"""The table of runs: a row per config with its objective, the best first and ready to paste."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.markup import escape
from rich.table import Table

from negopipe.report.figures import render
from negopipe.sweeping.console import show
from negopipe.sweeping.groups import LeftOut
from negopipe.sweeping.objective import objective
from negopipe.sweeping.parallel_coordinates import parallel_coordinates
from negopipe.sweeping.swept_runs import SweptRun, as_json, differing_keys
from negopipe.tracking.csv_file import CsvKind, write_csv
from negopipe.tracking.names import without_implied
from negopipe.tracking.record import as_command

TABLE_NAME, FIGURE_NAME = "summary.csv", "parallel_coordinates"
OBJECTIVE, SPREAD, SEEDS, STATUS, RUNS = "objective", "objective_std", "seeds", "status", "runs"
"""Columns of the table after those of the config."""
SUMMARY = CsvKind("negopipe.sweeping.compare", {OBJECTIVE: float, SPREAD: float, SEEDS: int, "*": str})
"""summary.csv: a row per config, columns for the keys that differ and for the objective."""
N_SHOWN = 40
"""Rows of the table that are shown; summary.csv has all, and all keys that differ."""
N_AXES = 10


def write_table(target: Path, runs: Sequence[SweptRun], keys: Sequence[str] | None, minimize: bool) -> None:
    """Print the table and the best config, write summary.csv and the figure.

    keys: of metrics.json, their mean is the objective; None = the objective of the runs' own configs
    LeftOut where no config names an objective.
    """
    keys = keys or _own_objective(runs)
    table, differing = tabulate(runs, keys, minimize), differing_keys(runs)
    shown = without_implied(differing, [run.config for run in runs])
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
    print(f"best       {best.folder}{hint}\n\n  {paste(best, differing)}\n")


def tabulate(runs: Sequence[SweptRun], keys: Sequence[str], minimize: bool = False) -> pd.DataFrame:
    """A row per config, the best first: the keys that differ, mean and spread of the objective over its seeds.

    keys: of metrics.json, their mean is the objective
    Columns are `differing_keys(runs)`, OBJECTIVE (NaN where no seed has one), SPREAD (standard deviation, NaN for
    fewer than two), SEEDS (number with an objective), STATUS and RUNS (names of folders, the best first).
    """
    differing = differing_keys(runs)
    groups: dict[str, list[SweptRun]] = {}
    for run in runs:
        groups.setdefault(as_json([run.config.get(key) for key in differing]), []).append(run)
    rows = [_row(group, differing, keys, minimize) for group in groups.values()]
    table = pd.DataFrame(rows, columns=[*differing, OBJECTIVE, SPREAD, SEEDS, STATUS, RUNS], dtype=object)
    numbers = {name: pd.to_numeric(table[name]) for name in (OBJECTIVE, SPREAD, SEEDS)}
    return table.assign(**numbers).sort_values(OBJECTIVE, ascending=minimize, kind="stable", ignore_index=True)


def _row(group: list[SweptRun], differing: list[str], keys: Sequence[str], minimize: bool) -> list[Any]:
    values = {run.name: objective(run.metrics, keys) for run in group}
    known = pd.Series({name: value for name, value in values.items() if value is not None}, dtype=float)
    best_first = [*known.sort_values(ascending=minimize).index, *(name for name in values if name not in known)]
    statuses = [run.status for run in group]
    is_mixed = len(set(statuses)) > 1
    status = f"{statuses.count('finished')} of {len(group)} finished" if is_mixed else statuses[0]
    config = [group[0].config.get(key) for key in differing]
    return [*config, known.mean(), known.std(), len(known), status, " ".join(best_first)]


def paste(run: SweptRun, differing: Sequence[str]) -> str:
    """The command that makes the run's results, without its seed; several lines where it took several.

    Where it is not recorded it is made of the keys that differ, and the experiment has to be added by hand.
    """
    from_config = tuple(f"{key}={_override_text(run.config.get(key))}" for key in differing)
    commands = [[text for text in texts if not _is_seed(text)] for texts in run.commands or [from_config]]
    return "\n  ".join(dict.fromkeys(as_command(shlex.join(texts)) for texts in commands))


def _is_seed(override: str) -> bool:
    return override.lstrip("+").startswith("seed=")


def _own_objective(runs: Sequence[SweptRun]) -> list[str]:
    """The objective of the first run's config; a line says so where the runs have several."""
    found = [run.config["objective"] for run in runs if run.config.get("objective")]
    if not found:
        raise LeftOut("no config has an objective, --objective names one")
    if any(other != found[0] for other in found):
        print("objective  that of the first run; the others have other ones (--objective names one for all)")
    return list(found[0])


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
    show(view)
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
