"""Learning curves of a sweep: `python -m negopipe.sweeping.learning_curves outputs/<name> --by algorithm.kind`.

Groups the runs by keys of their config and draws, over decisions and over wall time, the mean of each group's seeds
and the range of all of them. Writes learning_curves.csv, .png and .svg to `outputs/sweeps/<name>/`. Given such a csv
instead of the runs' folder, it draws the figure again, beside it.
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
from negopipe.report.figures import render
from negopipe.report.style import OTHER_COLORS, QUIET, styled
from negopipe.sweeping.swept_runs import SweptRun, read_runs
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv
from negopipe.tracking.run_folder import HISTORY_NAME
from negopipe.tracking.training_files import HISTORY

COLORS = ("#00A0A0", "#E09000", "#1B1B4B", "#D64550", *OTHER_COLORS)
MEASURES = {"success_rate": "success rate", "return_mean": "return"}
"""Columns of history.csv that are drawn, both of the latest 200 episodes, and what they are called."""
AXES = {"decisions": ("decisions [thousands]", 1e-3), "wall_s": ("wall time [min]", 1 / 60)}
KEYS = ("group", "seed", *AXES)
"""Columns of learning_curves.csv beside the measures."""
CURVES = CsvKind(
    "negopipe.sweeping.learning_curves",
    {"group": str, "seed": int, "decisions": int, "wall_s": float, "success_rate": float, "return_mean": float},
)
"""learning_curves.csv: `KEYS` and `MEASURES`."""
N_POINTS = 100
"""Of a curve; seeds are compared at the same points."""
LOWEST = 1.0
"""Percentile of all returns at which the axis begins: the first iterations are far below all else."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 1 after a line that says what is wrong."""
    about = (__doc__ or "").partition("\n")[0]
    parser = argparse.ArgumentParser(prog="python -m negopipe.sweeping.learning_curves", description=about)
    parser.add_argument("source", type=Path, help="outputs/<name>: the folder that holds the runs; or a csv")
    parser.add_argument("--by", nargs="+", default=[], metavar="KEY", help="of the config: its values are compared")
    parser.add_argument("--sweep", help="only runs with this tag `sweep`")
    parser.add_argument("--every", type=_positive, default=1, help="keep a row per so many iterations (default: 1)")
    given = parser.parse_args(arguments)
    try:
        if given.source.suffix == ".csv":
            table, target = read_table(given.source), given.source.with_suffix("")
        else:
            table = read_curves(given.source, given.by, given.sweep, given.every)
            target = given.source.parent / "sweeps" / (given.sweep or given.source.name) / "learning_curves"
            target.parent.mkdir(parents=True, exist_ok=True)
            write_csv(Path(f"{target}.csv"), table, CURVES)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    figure = learning_curves(table)
    for kind in ("png", "svg"):
        Path(f"{target}.{kind}").write_bytes(render(figure, kind))
    print(f"curves     {target}.csv\nfigure     {target}.png")
    return 0


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"must be a whole number above 0, got {text}")
    return int(text)


def read_table(path: Path) -> pd.DataFrame:
    """A learning_curves.csv; UserError if it is none."""
    return read_csv(path, CURVES, CURVES.columns)


def read_curves(folder: Path, by: Sequence[str], sweep: str | None = None, every: int = 1) -> pd.DataFrame:
    """Each `every`-th row of the runs' history.csv, with columns `group` (values of `by`) and `seed`.

    UserError if there are none.
    """
    runs = [run for run in read_runs(folder, sweep) if (folder / run.name / HISTORY_NAME).exists()]
    unknown = [key for key in by if not any(key in run.config for run in runs)]
    if not runs:
        raise UserError(f"{folder}: no run in it has a {HISTORY_NAME}")
    if unknown or not by:
        raise UserError(f"--by must be keys of the config such as algorithm.kind, got {(unknown or ['none'])[0]}")
    columns = [*AXES, *MEASURES]
    tables = [
        read_csv(folder / run.name / HISTORY_NAME, HISTORY, columns)[columns][every - 1 :: every].assign(
            group=_group(run, by), seed=run.config["seed"]
        )
        for run in runs
    ]
    return pd.concat(tables, ignore_index=True)[[*KEYS, *MEASURES]]


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
