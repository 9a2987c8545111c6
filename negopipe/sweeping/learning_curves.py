"""Learning curves of groups of runs: success rate and return while training, over decisions and over wall time.

learning_curves.csv holds rows of all runs' history.csv; the figure is drawn from it alone, so it can be drawn again.
"""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from negopipe.report.figures import render
from negopipe.report.style import OTHER_COLORS, QUIET, styled
from negopipe.sweeping.groups import Groups, LeftOut
from negopipe.sweeping.swept_runs import SweptRun
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv
from negopipe.tracking.run_folder import HISTORY_NAME
from negopipe.tracking.training_files import HISTORY

COLORS = ("#00A0A0", "#E09000", "#1B1B4B", "#D64550", *OTHER_COLORS)
"""A colour per group; there are as many curves at most."""
MEASURES = {"success_rate": "success rate", "return_mean": "return"}
"""Columns of history.csv that are drawn, both of the latest 200 episodes, and their labels."""
AXES = {"decisions": ("decisions [thousands]", 1e-3), "wall_s": ("wall time [min]", 1 / 60)}
COLUMNS = ("group", "seed", *AXES, *MEASURES)
CURVES = CsvKind(
    "negopipe.sweeping.compare",
    {"group": str, "seed": int, "decisions": int, "wall_s": float, "success_rate": float, "return_mean": float},
)
"""learning_curves.csv: `COLUMNS`."""
N_POINTS = 100
"""Points of a curve; the runs of a group are compared at the same ones."""
LOWEST = 1.0
"""Percentile of all returns at which the axis begins: the first iterations are far below all else."""
SHORTEST = 0.5
"""Share of its group's longest run that a run must reach to count in the curve, which ends with the shortest."""
LEGEND_CHARACTERS, HANDLE_CHARACTERS, LONGEST_LABEL = 118, 9, 100
"""Characters that fit above the figure, that a label's line takes of them, and of the label itself at most."""
LEGEND_LINES, LINE_IN = 3, 0.19
"""Lines of the legend that the figure has room for, and the height of each further one."""


def write_curves(target: Path, runs: Sequence[SweptRun], groups: Groups, every: int) -> None:
    """Write learning_curves.csv, .png and .svg. LeftOut if no run has a history.

    every: of so many iterations one row is kept
    """
    table = read_curves(runs, groups, every)
    if table.empty:
        raise LeftOut(f"no run has a {HISTORY_NAME} with {every} iteration{'s' if every > 1 else ''}")
    write_csv(target / "learning_curves.csv", table, CURVES)
    print(f"curves     {target / 'learning_curves.csv'}")
    draw_curves(target / "learning_curves.csv")


def draw_curves(path: Path) -> None:
    """Draw the figure of a learning_curves.csv beside it; UserError if it is none."""
    table = read_csv(path, CURVES, COLUMNS)
    figure = learning_curves(table)
    for kind in ("png", "svg"):
        path.with_suffix(f".{kind}").write_bytes(render(figure, kind))
    n_groups, n_drawn = table["group"].nunique(), len(drawn_groups(table))
    told = f" (of {n_groups} groups the {n_drawn} with the highest last return)" if n_drawn < n_groups else ""
    print(f"figure     {path.with_suffix('.png')}{told}")


def read_curves(runs: Sequence[SweptRun], groups: Groups, every: int = 1) -> pd.DataFrame:
    """Each `every`-th row of the runs' history.csv, with columns `group` and `seed`; empty where none was trained."""
    name_of = {run.folder: name for name, members in groups.items() for run in members}
    columns = [*AXES, *MEASURES]
    tables = [
        read_csv(run.folder / HISTORY_NAME, HISTORY, columns)[columns][every - 1 :: every].assign(
            group=name_of[run.folder], seed=run.config["seed"]
        )
        for run in runs
        if run.holds(HISTORY_NAME)
    ]
    return pd.concat(tables, ignore_index=True)[list(COLUMNS)] if tables else pd.DataFrame(columns=list(COLUMNS))


@styled
def learning_curves(table: pd.DataFrame) -> Figure:
    """A panel per measure and x-axis: a line per group, the mean of its runs, in a band from lowest to highest."""
    figure = Figure((7.2, 4.6), layout="constrained")
    panels = figure.subplots(len(MEASURES), len(AXES), sharey="row")
    groups = drawn_groups(table)
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
    _add_legend(figure, handles, [textwrap.fill(label, LONGEST_LABEL) for label in labels])
    return figure


def _add_legend(figure: Figure, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """In as many columns as fit; the figure grows with its lines."""
    lines = [label.splitlines() for label in labels]
    longest = max((len(line) for label in lines for line in label), default=1)
    n_columns = min(4, max(1, LEGEND_CHARACTERS // (longest + HANDLE_CHARACTERS)), max(1, len(labels)))
    n_lines = -(-sum(map(len, lines)) // n_columns)
    figure.set_figheight(figure.get_figheight() + LINE_IN * max(0, n_lines - LEGEND_LINES))
    figure.legend(handles, labels, loc="outside upper center", ncols=n_columns)


def drawn_groups(table: pd.DataFrame) -> list[str]:
    """All groups, or as many as there are colours: those with the highest last return."""
    groups = list(table["group"].unique())
    last = table.dropna(subset=["return_mean"]).groupby(["group", "seed"])["return_mean"].last()
    best = last.groupby("group").mean().sort_values(ascending=False, kind="stable").index
    ranked = [*best, *(group for group in groups if group not in best)][: len(COLORS)]
    return [group for group in groups if group in ranked]


def _curve(axis: Axes, rows: pd.DataFrame, x: str, measure: str, scale: float, color: str) -> None:
    runs = [part for part in (part.dropna(subset=[measure]) for part in _single_runs(rows)) if len(part) > 0]
    if not runs:  # no episode was over yet
        return
    longest = max(part["decisions"].max() for part in runs)
    runs = [part for part in runs if part["decisions"].max() >= SHORTEST * longest]
    start, end = max(part[x].min() for part in runs), min(part[x].max() for part in runs)
    at = np.linspace(start, end, N_POINTS)
    values = np.stack([np.interp(at, part[x], part[measure]) for part in runs])
    noun = "seed" if len({part["seed"].iloc[0] for part in runs}) == len(runs) else "run"
    name = f"{rows['group'].iloc[0]} ({len(runs)} {noun}{'s' if len(runs) > 1 else ''})"
    axis.fill_between(scale * at, values.min(0), values.max(0), color=color, alpha=0.2, linewidth=0)
    axis.plot(scale * at, values.mean(0), color=color, linewidth=1.6, label=name)
    axis.tick_params(color=QUIET)


def _single_runs(rows: pd.DataFrame) -> list[pd.DataFrame]:
    """The rows of each run: a seed's decisions begin again with the next run of that seed."""
    begins = rows.groupby("seed")["decisions"].diff().fillna(1) <= 0
    number = begins.astype(int).groupby(rows["seed"]).cumsum()
    return [part for _, part in rows.groupby([rows["seed"], number])]
