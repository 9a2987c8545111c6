"""Learning curves of a sweep: `python -m negopipe.sweeping.learning_curves outputs/<name> --by algorithm.kind`.

Groups the runs by keys of their config and draws, over decisions and over wall time, the mean of each group's seeds
and the range of all of them. Writes learning_curves.csv, .png and .svg to `outputs/sweeps/<name>/`.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from negopipe.errors import UserError
from negopipe.report.figures import OTHER_COLORS, QUIET, render, styled
from negopipe.sweeping.swept_runs import SweptRun, read_runs
from negopipe.tracking.run_folder import HISTORY_NAME

COLORS = ("#00A0A0", "#E09000", "#1B1B4B", "#D64550", *OTHER_COLORS)
MEASURES = {"success_rate": "success rate", "return_mean": "return"}
"""Columns of history.csv that are drawn, both of the latest 200 episodes, and what they are called."""
AXES = {"decisions": ("decisions [thousands]", 1e-3), "wall_s": ("wall time [min]", 1 / 60)}
N_POINTS = 100
"""Of a curve; seeds are compared at the same points."""
LOWEST = 1.0
"""Percentile of all returns at which the axis begins: the first iterations are far below all else."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 1 after a line that says what is wrong."""
    about = (__doc__ or "").partition("\n")[0]
    parser = argparse.ArgumentParser(prog="python -m negopipe.sweeping.learning_curves", description=about)
    parser.add_argument("folder", type=Path, help="outputs/<name>: the folder that holds the runs")
    parser.add_argument("--by", nargs="+", required=True, metavar="KEY", help="of the config: its values are compared")
    parser.add_argument("--sweep", help="only runs with this tag `sweep`")
    given = parser.parse_args(arguments)
    try:
        table = read_curves(given.folder, given.by, given.sweep)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    target = given.folder.parent / "sweeps" / (given.sweep or given.folder.name)
    target.mkdir(parents=True, exist_ok=True)
    table.to_csv(target / "learning_curves.csv", index=False)
    figure = learning_curves(table)
    for kind in ("png", "svg"):
        (target / f"learning_curves.{kind}").write_bytes(render(figure, kind))
    print(f"curves     {target / 'learning_curves.csv'}\nfigure     {target / 'learning_curves.png'}")
    return 0


def read_curves(folder: Path, by: Sequence[str], sweep: str | None = None) -> pd.DataFrame:
    """Rows of the runs' history.csv with columns `group` (values of `by`) and `seed`; UserError if there are none."""
    runs = [run for run in read_runs(folder, sweep) if (folder / run.name / HISTORY_NAME).exists()]
    unknown = [key for key in by if not any(key in run.config for run in runs)]
    if not runs:
        raise UserError(f"{folder}: no run in it has a {HISTORY_NAME}")
    if unknown:
        raise UserError(f"--by must be keys of the config such as algorithm.kind, got {unknown[0]}")
    columns = ["decisions", "wall_s", *MEASURES]
    tables = [
        pd.read_csv(folder / run.name / HISTORY_NAME, usecols=columns).assign(
            group=_group(run, by), seed=run.config["seed"]
        )
        for run in runs
    ]
    return pd.concat(tables, ignore_index=True)[["group", "seed", *columns]]


def _group(run: SweptRun, by: Sequence[str]) -> str:
    return ", ".join(str(run.config.get(key, "-")) for key in by)


@styled
def learning_curves(table: pd.DataFrame) -> Figure:
    """A panel per measure and x-axis: a line per group, the mean of its seeds, in a band from lowest to highest."""
    figure = Figure((7.2, 4.6), layout="constrained")
    panels = figure.subplots(len(MEASURES), len(AXES), sharey="row")
    groups = list(table["group"].unique())
    for row, (measure, label) in zip(panels, MEASURES.items(), strict=True):
        for axis, (x, (x_label, scale)) in zip(row, AXES.items(), strict=True):
            for group, color in zip(groups, COLORS, strict=False):
                _curve(axis, table[table["group"] == group], x, measure, scale, color)
            axis.set_xlabel(x_label)
            axis.grid(axis="y")
        row[0].set_ylabel(label)
    panels[0, 0].set_ylim(-0.02, 1.02)
    if table["return_mean"].notna().any():
        panels[1, 0].set_ylim(bottom=float(np.nanpercentile(table["return_mean"], LOWEST)))
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(4, len(groups)))
    return figure


def _curve(axis: Axes, rows: pd.DataFrame, x: str, measure: str, scale: float, color: str) -> None:
    seeds = [part.dropna(subset=[measure]) for _, part in rows.groupby("seed")]
    seeds = [part for part in seeds if len(part) > 0]
    if not seeds:  # no episode was over yet
        return
    start, end = max(part[x].min() for part in seeds), min(part[x].max() for part in seeds)
    at = np.linspace(start, end, N_POINTS)
    values = np.stack([np.interp(at, part[x], part[measure]) for part in seeds])
    name = f"{rows['group'].iloc[0]} ({len(seeds)} seed{'s' if len(seeds) > 1 else ''})"
    axis.fill_between(scale * at, values.min(0), values.max(0), color=color, alpha=0.2, linewidth=0)
    axis.plot(scale * at, values.mean(0), color=color, linewidth=1.6, label=name)
    axis.tick_params(color=QUIET)


if __name__ == "__main__":
    sys.exit(main())
