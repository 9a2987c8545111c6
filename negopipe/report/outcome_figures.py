"""Figures of outcomes: arrivals over time, shares of outcomes, success by style, outcomes by task.

Every function takes data and returns a matplotlib Figure 4.4 inches wide, like those of `negopipe.report.figures`.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.trace import ADAPTIVE, OUTCOMES
from negopipe.report.figures import outcome_legend, settings_and_planners
from negopipe.report.labels import horizon_number, planner_label, setting_label
from negopipe.report.style import INK, OUTCOME_COLORS, QUIET, WIDTH_IN, planner_colors, styled

BIN_M = 0.2
"""Width of a column of start distances; the first and the last end with the distances themselves."""


@styled
def arrivals(table: pd.DataFrame, fixed_s: FixedHorizons) -> Figure:
    """Share of all episodes in which the ego has arrived by a time, for every planner, one panel per setting."""
    settings, planners = settings_and_planners(table)
    figure = Figure((WIDTH_IN, 0.9 + 1.7 * len(settings)), layout="constrained")
    axes = figure.subplots(len(settings), 1, sharex=True, squeeze=False)[:, 0]
    colors = planner_colors(planners, fixed_s)
    for axis, setting in zip(axes, settings, strict=True):
        for planner, rows in table[table["setting"] == setting].groupby("planner", sort=False):
            _arrival_curve(axis, rows["ego_time_s"], colors[str(planner)], is_adaptive=planner == ADAPTIVE)
        axis.set(ylim=(0, 103), ylabel="ego arrived [%]", title=setting_label(setting))
        axis.grid(axis="y")
    latest_s = table["ego_time_s"].max()
    axes[-1].set(xlabel="time [s]", xlim=(0, 1.0 if np.isnan(latest_s) else 1.05 * latest_s))  # NaN: nobody arrived
    handles = [Patch(color=color, label=planner_label(name, fixed_s)) for name, color in colors.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, handlelength=1.0)
    return figure


def _arrival_curve(axis: Axes, time_s: pd.Series, color: str, is_adaptive: bool) -> None:
    arrived = np.sort(time_s.dropna().to_numpy())
    share = 100 * np.arange(1, len(arrived) + 1) / len(time_s)
    x = np.concatenate([[0.0], arrived, [1e3]])
    y = np.concatenate([[0.0], share, share[-1:] if len(share) else [0.0]])
    axis.step(x, y, where="post", color=color, linewidth=2.2 if is_adaptive else 1.3, zorder=3 if is_adaptive else 2)


@styled
def outcomes(table: pd.DataFrame, fixed_s: FixedHorizons) -> Figure:
    """Outcomes of every planner, one stacked bar each, one panel per setting."""
    settings, planners = settings_and_planners(table)
    figure = Figure((WIDTH_IN, 0.7 + (0.5 + 0.26 * len(planners)) * len(settings)), layout="constrained")
    axes = figure.subplots(len(settings), 1, sharex=True, squeeze=False)[:, 0]
    for axis, setting in zip(axes, settings, strict=True):
        rows = table[table["setting"] == setting]
        share = pd.crosstab(rows["planner"], rows["outcome"], normalize="index") * 100
        _stacked_bars(axis, share.reindex(index=planners, columns=list(OUTCOMES), fill_value=0.0))
        axis.set_yticks(range(len(planners)), [planner_label(planner, fixed_s) for planner in planners])
        axis.set_title(setting_label(setting))
    axes[-1].set_xlabel("episodes [%]")
    outcome_legend(figure, table["outcome"].unique())
    return figure


def _stacked_bars(axis: Axes, share: pd.DataFrame) -> None:
    """Rows of `share` as horizontal bars, columns as segments with their percentage where it fits."""
    left = np.zeros(len(share))
    for outcome in share.columns:
        width = share[outcome].to_numpy()
        axis.barh(range(len(share)), width, left=left, height=0.72, color=OUTCOME_COLORS[outcome])
        color = "white" if outcome == "deadlock" else INK
        for row in np.flatnonzero(width >= 6).tolist():
            center = left[row] + width[row] / 2
            axis.text(center, row, f"{width[row]:.0f}", ha="center", va="center", color=color, fontsize=8)
        left += width
    axis.set(xlim=(0, 100), ylim=(len(share) - 0.5, -0.5))
    axis.tick_params(axis="y", length=0)


OPPONENT_LABEL = {
    False: "prediction horizon of the social driver [s], short = aggressive",
    True: "driver of the nearest social vehicle",
}
"""Label of an axis of styles, and of one of drivers."""

MOST_STYLES = 8
"""Styles that are told apart; more of them, as from an interval, are rounded to seconds."""


def has_drivers(table: pd.DataFrame) -> bool:
    """Whether several drivers of a population meet the ego."""
    return "social_driver" in table and table["social_driver"].nunique() > 1


def opponent(table: pd.DataFrame) -> pd.Series:
    """Whom the ego meets in each episode: the driver's name where there are several drivers, else the style in s."""
    if has_drivers(table):
        return table["social_driver"]
    styles = table["style_horizon_s"]
    return styles if styles.nunique() <= MOST_STYLES else styles.round()


def _opponent_text(name: float | str) -> str:
    return name if isinstance(name, str) else horizon_number(name)


@styled
def success_by_style(table: pd.DataFrame, fixed_s: FixedHorizons) -> Figure:
    """Success rate of every planner against every style of the social driver, one panel per setting."""
    settings, planners = settings_and_planners(table)
    figure = Figure((WIDTH_IN, 0.5 + (0.5 + 0.26 * len(planners)) * len(settings)), layout="constrained")
    axes = figure.subplots(len(settings), 1, sharex=True, squeeze=False)[:, 0]
    ended = table.assign(is_success=table["outcome"] == "success")
    for axis, setting in zip(axes, settings, strict=True):
        rows = ended[ended["setting"] == setting]
        rate = 100 * rows.pivot_table(index="planner", columns=opponent(rows), values="is_success")
        _rates(axis, rate.reindex(index=planners))
        axis.set_yticks(range(len(planners)), [planner_label(planner, fixed_s) for planner in planners])
        axis.set_title(f"{setting_label(setting)}: success rate [%]")
    axes[-1].set_xlabel(OPPONENT_LABEL[has_drivers(table)])
    return figure


def _rates(axis: Axes, rate: pd.DataFrame) -> None:
    """Rows are planners, columns styles; a planner that did not drive has an empty row."""
    axis.imshow(rate, cmap="Blues", vmin=0, vmax=130, aspect="auto")
    for (row, column), value in np.ndenumerate(rate.to_numpy()):
        text = "" if np.isnan(value) else f"{value:.0f}"
        axis.text(column, row, text, ha="center", va="center", color="white" if value > 75 else INK, fontsize=8)
    axis.set_xticks(range(rate.shape[1]), [_opponent_text(name).replace("_", "\n") for name in rate.columns])
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)


@styled
def outcome_map(
    episodes: pd.DataFrame, title: str, unseen_m: Sequence[tuple[float, float]], whole: pd.DataFrame | None = None
) -> Figure:
    """Outcomes by the social driver's style (rows) and start distance (columns).

    episodes: rows of one planner with social_start_distance_m, style_horizon_s and outcome
    unseen_m: intervals of start distance, m, that training left out, marked below the columns
    whole: episodes that set the axes; None = `episodes`
    """
    whole = episodes if whole is None else whole
    distance = whole["social_start_distance_m"].to_numpy()
    edges = BIN_M * np.arange(np.floor(distance.min() / BIN_M), np.floor(distance.max() / BIN_M) + 2)
    edges = edges.clip(distance.min(), distance.max())
    rows_of, all_rows = opponent(episodes), opponent(whole)
    styles = np.sort(all_rows.unique())
    figure = Figure((WIDTH_IN, 1.3 + 0.45 * len(styles)), layout="constrained")
    axis = figure.subplots()
    for row, style in enumerate(styles):
        of_style = episodes[rows_of == style]
        _outcome_bars(axis, row, of_style, edges)
    for first, last in unseen_m:
        axis.plot(
            (first, last), (len(styles) - 0.42,) * 2, color=INK, linewidth=3, solid_capstyle="butt", clip_on=False
        )
    axis.set(xlim=(edges[0] - BIN_M, edges[-1] + BIN_M), ylim=(len(styles) - 0.35, -0.5))
    axis.set_yticks(range(len(styles)), [_opponent_text(style) for style in styles])
    axis.set_xlabel("start distance of the social driver [m]")
    axis.set_ylabel("driver" if has_drivers(whole) else "style [s]")
    axis.set_title(title)
    axis.tick_params(axis="y", length=0)
    outcome_legend(figure, whole["outcome"].unique())
    return figure


def training_maps(
    episodes: pd.DataFrame, unseen_m: Sequence[tuple[float, float]], n_maps: int
) -> Iterator[tuple[int, Figure]]:
    """Outcomes of `n_maps` equal parts of the training: decisions before each part, and its map.

    episodes: training_episodes.csv
    """
    outcome = np.select([episodes["is_success"] == 1, episodes["is_collision"] == 1], OUTCOMES[:2], default="timeout")
    episodes = episodes.assign(outcome=outcome)
    ends = np.linspace(0, episodes["decisions"].max(), n_maps + 1).round().astype(int)
    for start, end in pairwise(ends.tolist()):
        part = episodes[episodes["decisions"].between(start, end, inclusive="right")]
        title = f"Training, {start / 1e6:.2f} to {end / 1e6:.2f} million decisions"
        yield start, outcome_map(part, title, unseen_m, whole=episodes)


def _outcome_bars(axis: Axes, row: int, episodes: pd.DataFrame, edges: np.ndarray) -> None:
    """A stacked bar of shares, from below, for every column of start distances that has episodes."""
    axis.axhline(row + 0.38, color=QUIET, linewidth=0.5)
    if episodes.empty:
        return
    column = np.searchsorted(edges, episodes["social_start_distance_m"].to_numpy(), side="right") - 1
    column = column.clip(max=len(edges) - 2)
    share = pd.crosstab(column, episodes["outcome"], normalize="index").reindex(columns=list(OUTCOMES), fill_value=0.0)
    at, width = (values[share.index.to_numpy(dtype=int)] for values in (edges, np.diff(edges)))
    base = np.full(len(share), row + 0.38)
    for outcome in OUTCOMES:
        height = 0.76 * share[outcome].to_numpy()
        color = OUTCOME_COLORS[outcome]  # of the edges, too, or seams show between the columns
        some = height > 0  # the edges of an empty bar would be seen
        bars: Any = {"bottom": base[some], "align": "edge", "color": color, "edgecolor": color, "linewidth": 0.4}
        axis.bar(at[some], -height[some], width[some], **bars)
        base = base - height
