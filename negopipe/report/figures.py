"""Figures of the evaluation's table, its traces and the training history, the paper's among them.

Every function takes data and returns a matplotlib Figure 4.4 inches wide: a column in print, and still
readable on a phone. Planner colours are the same in every figure: a fixed horizon has the colour of its
horizon, from amber (0 s, no prediction) to navy (6 s, cautious); blue is infinite. The colours stay apart under the
three common colour vision deficiencies (smallest CIE76 difference 27).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from io import BytesIO

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from negopipe.evaluation import measures
from negopipe.evaluation.metrics import behaviour_index, running
from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.trace import ADAPTIVE, OUTCOMES, Trace
from negopipe.report.labels import horizon_label, outcome_label, planner_label, setting_label
from negopipe.report.style import (
    ADAPTIVE_COLOR,
    CORRIDOR,
    INK,
    OUTCOME_COLORS,
    QUIET,
    STYLE,
    WIDTH_IN,
    horizon_color,
    planner_colors,
    styled,
)
from negopipe.simulation.state import EGO


def outcome_legend(figure: Figure, outcomes: Collection[str]) -> None:
    """A legend of `outcomes` above the figure, in the same order everywhere."""
    handles = [Patch(color=c, label=outcome_label(name)) for name, c in OUTCOME_COLORS.items() if name in outcomes]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), handlelength=1.0, columnspacing=1.0)


COMPARED = ("driving_time_s", "suspend_count", "suspend_time_s", "reward")
"""Measures whose distributions the paper compares."""


@styled
def comparison(table: pd.DataFrame, fixed_s: FixedHorizons) -> Figure:
    """The paper's measures of every planner: arrivals and the distributions of `COMPARED`.

    Boxes hold the middle half of the episodes, whiskers reach from the 10th to the 90th percentile, the line
    is the median, the dot and the number are the mean.
    """
    settings, planners = settings_and_planners(table)
    drawn = [measure for name in COMPARED for measure in measures.MEASURES if measure.name == name]
    size = (WIDTH_IN, 1.0 + (0.35 + 0.16 * len(planners)) * 5)
    figure = Figure(size, layout="constrained")
    axes = figure.subplots(5, len(settings), sharex="row", sharey=True, squeeze=False)
    colors = planner_colors(planners, fixed_s)
    for column, setting in enumerate(settings):
        rows = table[table["setting"] == setting]
        by_planner = [rows[rows["planner"] == planner] for planner in planners]
        _arrival_bars(axes[0, column], by_planner, list(colors.values()))
        for axis, measure in zip(axes[1:, column], drawn, strict=True):
            _boxes(axis, [part[measure.column].dropna().to_numpy() for part in by_planner], list(colors.values()))
            axis.set_xlabel(f"{measure.label} [{measure.unit or 1}]")
        axes[0, column].set_title(setting_label(setting))
    axes[0, 0].set_yticks(range(len(planners)), [planner_label(planner, fixed_s) for planner in planners])
    axes[0, 0].set_ylim(len(planners) - 0.5, -0.5)
    return figure


def _arrival_bars(axis: Axes, by_planner: list[pd.DataFrame], colors: list[str]) -> None:
    share = [100 * part["driving_time_s"].notna().mean() for part in by_planner]
    axis.barh(range(len(colors)), share, height=0.62, color=colors)
    axis.set_xlim(0, 100)
    axis.set_xlabel("ego arrived [% of episodes]")
    _row_numbers(axis, [f"{value:.0f}" for value in share])


def _boxes(axis: Axes, samples: list[np.ndarray], colors: list[str]) -> None:
    boxes = axis.boxplot(
        samples,
        positions=range(len(colors)),
        orientation="horizontal",
        widths=0.62,
        whis=(10, 90),
        showfliers=False,
        showmeans=True,
        showcaps=False,
        patch_artist=True,
        manage_ticks=False,
        medianprops={"color": INK, "linewidth": 1.4},
        whiskerprops={"color": QUIET},
        meanprops={"marker": "o", "markeredgecolor": "white", "markersize": 5.5},
    )
    for patch, mean, color in zip(boxes["boxes"], boxes["means"], colors, strict=True):
        patch.set(facecolor=color, edgecolor=color, alpha=0.55)
        mean.set_markerfacecolor(color)
    axis.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], integer=True))
    _row_numbers(axis, [f"{sample.mean():.1f}" if len(sample) else "none" for sample in samples])


def _row_numbers(axis: Axes, texts: list[str]) -> None:
    """A number at the right end of every row, and grid lines behind the rows."""
    axis.grid(axis="x")
    axis.set_axisbelow(True)
    axis.tick_params(axis="y", length=0)
    for row, text in enumerate(texts):
        axis.text(1.02, row, text, transform=axis.get_yaxis_transform(), va="center", fontsize=8)


@styled
def behaviour(traces: Sequence[Trace], fixed_s: FixedHorizons) -> Figure:
    """The behaviour index of Eq. 7 over time: adaptive as median and 10-90 % band, others as medians.

    A curve ends where fewer than a quarter of the planner's episodes still run.
    """
    settings = _settings(traces)
    figure = Figure((WIDTH_IN, 0.6 + 1.9 * len(settings)), layout="constrained")
    axes = figure.subplots(len(settings), 1, sharex=True, squeeze=False)[:, 0]
    colors = planner_colors([trace.planner for trace in traces], fixed_s)
    for axis, setting in zip(axes, settings, strict=True):
        for trace in (trace for trace in traces if trace.setting == setting):
            _behaviour_curve(axis, trace, colors[trace.planner])
        axis.axhline(0, color=QUIET, linewidth=0.8)
        axis.set(ylim=(-95, 95), ylabel="behaviour index ψ [°]", title=setting_label(setting))
        axis.set_yticks([-90, -45, 0, 45, 90])
        for y, text in ((0.75, "prosocial"), (0.25, "competitive")):
            axis.text(1.01, y, text, transform=axis.transAxes, va="center", rotation=270, fontsize=8)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(left=0)
    _planner_legend(figure, colors, fixed_s)
    return figure


def _behaviour_curve(axis: Axes, trace: Trace, color: str) -> None:
    psi = np.degrees(behaviour_index(trace))
    psi = psi[np.isfinite(psi).mean(1) >= 0.25]
    low, median, high = np.nanpercentile(psi, (10, 50, 90), axis=1)
    time_s = np.arange(len(psi)) * trace.dt_s
    is_adaptive = trace.planner == ADAPTIVE
    if is_adaptive:
        axis.fill_between(time_s, low, high, color=color, alpha=0.25, linewidth=0)
    axis.plot(time_s, median, color=color, linewidth=2.2 if is_adaptive else 1.3, zorder=3 if is_adaptive else 2)


@styled
def horizons(traces: Sequence[Trace]) -> Figure:
    """Prediction horizons of the adaptive planner over time, as shares of all its episodes."""
    adaptive = [trace for trace in traces if trace.planner == ADAPTIVE]
    figure = Figure((WIDTH_IN, 0.7 + 1.5 * len(adaptive)), layout="constrained")
    axes = figure.subplots(len(adaptive), 1, sharex=True, squeeze=False)[:, 0]
    chosen = np.concatenate([trace.horizon_s[:, :, EGO][running(trace)] for trace in adaptive])
    levels = np.unique(chosen)
    for axis, trace in zip(axes, adaptive, strict=True):
        edges_s = np.arange(len(trace.reward) + 1) * trace.dt_s
        base = np.zeros(len(trace.reward))
        for level in levels:
            share = 100 * (running(trace) & (trace.horizon_s[:, :, EGO] == level)).mean(1)
            axis.stairs(base + share, edges_s, baseline=base, fill=True, color=horizon_color(level))
            base = base + share
        axis.stairs(base, edges_s, baseline=None, color=INK, linewidth=0.8)
        axis.set(ylim=(0, 100), ylabel="episodes [%]", title=setting_label(trace.setting))
    axes[-1].set(xlabel="time [s]", xlim=(0, max(trace.n_steps.max() * trace.dt_s for trace in adaptive)))
    _horizon_legend(figure, levels)
    return figure


@styled
def horizons_along(traces: Sequence[Trace]) -> Figure:
    """Prediction horizons of the adaptive planner along the road, as shares of its decisions before it arrives.

    Corridors of several lengths are drawn as one of their mean length.
    """
    adaptive = [trace for trace in traces if trace.planner == ADAPTIVE]
    figure = Figure((WIDTH_IN, 0.7 + 1.5 * len(adaptive)), layout="constrained")
    axes = figure.subplots(len(adaptive), 1, sharex=True, squeeze=False)[:, 0]
    corridor_length_m = float(np.concatenate([trace.corridor_m for trace in adaptive]).mean())
    driven = [_decided(trace, corridor_length_m) for trace in adaptive]
    places, chosen = (np.concatenate(parts) for parts in zip(*driven, strict=True))
    edges_m = np.arange(np.floor(places.min()), np.ceil(places.max()) + 1)
    levels = np.unique(chosen)
    for axis, trace, (place, horizon) in zip(axes, adaptive, driven, strict=True):
        counts = np.stack([np.histogram(place[horizon == level], edges_m)[0] for level in levels])
        tops = 100 * counts.cumsum(0) / np.maximum(counts.sum(0), 1)
        for level, top, base in zip(levels, tops, np.vstack([np.zeros_like(tops[:1]), tops[:-1]]), strict=True):
            axis.stairs(top, edges_m, baseline=base, fill=True, color=horizon_color(level))
        for mouth_m in (0.0, corridor_length_m):
            axis.axvline(mouth_m, color="white", linewidth=2.2)
            axis.axvline(mouth_m, color=INK, linestyle="--", linewidth=1.0)
        axis.set(ylim=(0, 100), ylabel="decisions [%]", title=setting_label(trace.setting))
        if edges_m[0] < corridor_length_m / 2 < edges_m[-1]:  # a text beside the axes would leave them no room
            axis.text(corridor_length_m / 2, 102, "corridor", ha="center", va="bottom", color=QUIET, fontsize=8.5)
    axes[-1].set(xlabel="ego from the mouth of the corridor [m]", xlim=(edges_m[0], edges_m[-1]))
    _horizon_legend(figure, levels)
    return figure


def _decided(trace: Trace, corridor_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Progress, m, and horizon, s, of all decisions that the ego took before it arrived, flat.

    corridor_m: length that every corridor is stretched to
    """
    reached = trace.reached_step[:, EGO]
    end = np.where(reached >= 0, np.minimum(reached, trace.n_steps), trace.n_steps)
    is_driving = np.arange(len(trace.reward))[:, None] < end
    progress_m, own_m = trace.progress_m[:-1, :, EGO], trace.corridor_m
    within = progress_m.clip(0, own_m)
    stretched = progress_m - within + within * (corridor_m / own_m)
    return stretched[is_driving], trace.horizon_s[:, :, EGO][is_driving]


@styled
def space_time(traces: Sequence[Trace], episode: int, fixed_s: FixedHorizons) -> Figure:
    """One episode under every planner: positions of both vehicles along the road's reference line over time.

    traces: of one setting; the ego's line has the colour of the prediction horizon of that decision
    """
    half_m = float(traces[0].corridor_m[episode]) / 2
    figure, axes = _two_columns(len(traces), 1.6)
    road_end_m = 1.1 * max(np.abs(trace.progress_m[0, episode] - half_m).max() for trace in traces)
    duration_s = max(trace.n_steps[episode] * trace.dt_s for trace in traces)
    for axis, trace in zip(axes, traces, strict=True):
        axis.axhspan(-half_m, half_m, color=CORRIDOR, zorder=0)
        _space_time_lines(axis, trace, episode, half_m)
        outcome = outcome_label(OUTCOMES[trace.outcome[episode]])
        axis.set_title(f"{planner_label(trace.planner, fixed_s)}: {outcome}")
        axis.set(xlim=(0, 1.03 * duration_s), ylim=(-road_end_m, road_end_m))
    for axis in axes[::2]:
        axis.set_ylabel("along the road [m]")
    figure.supxlabel("time [s]", fontsize=STYLE["axes.labelsize"])
    chosen = np.concatenate([trace.horizon_s[: trace.n_steps[episode], episode, EGO] for trace in traces])
    social = Line2D([], [], color=INK, linestyle="--", label="social vehicle")
    corridor = Patch(color=CORRIDOR, label="corridor")
    _horizon_legend(figure, np.unique(chosen[~np.isnan(chosen)]), [social, corridor], n_columns=3)
    return figure


def _space_time_lines(axis: Axes, trace: Trace, episode: int, half_m: float) -> None:
    end = trace.n_steps[episode]
    time_s = np.arange(end + 1) * trace.dt_s
    from_middle = trace.progress_m[: end + 1, episode] - half_m
    sigma = np.where(
        np.arange(from_middle.shape[1]) == EGO, from_middle, -from_middle
    )  # social vehicles drive towards it
    horizon = trace.horizon_s[:end, episode, EGO]
    points = np.stack([time_s, sigma[:, EGO]], -1)
    colors = [QUIET if np.isnan(h) else horizon_color(h) for h in horizon]
    segments = list(np.stack([points[:-1], points[1:]], 1))
    axis.add_collection(LineCollection(segments, colors=colors, linewidths=2.4, capstyle="round"))
    axis.plot(time_s, sigma[:, EGO + 1 :], color=INK, linestyle="--", linewidth=1.1)
    if OUTCOMES[trace.outcome[episode]] == "collision":
        axis.plot(time_s[-1], sigma[-1, EGO], "X", color=OUTCOME_COLORS["collision"], markersize=9, zorder=4)


TRAINING_PANELS = {
    "episodes [%]": ("success_rate", "collision_rate", "timeout_rate"),
    "return [reward]": ("return_mean",),
    "policy entropy [nat]": ("entropy",),
    "KL of an update [nat]": ("kl",),
    "value loss [1]": ("value_loss",),
    "speed [decisions/s]": ("decisions_per_s",),
}
"""Axis label -> columns of the training history; a column that the history lacks is not drawn."""


@styled
def training(history: pd.DataFrame) -> Figure:
    """Learning curves over decisions: logged values and their running mean; a dashed line begins a stage.

    Means of episodes have no curve in a training so short that no episode ends; the panel says so.
    """
    panels = {label: [name for name in names if name in history] for label, names in TRAINING_PANELS.items()}
    panels = {label: names for label, names in panels.items() if names}
    unit, unit_name = (1e6, "million") if history["decisions"].max() >= 1e6 else (1e3, "thousand")
    decisions = history["decisions"].to_numpy() / unit
    figure, axes = _two_columns(len(panels), 1.55)
    for axis, (label, names) in zip(axes, panels.items(), strict=True):
        for name in names:
            _learning_curve(axis, decisions, history[name] * (100 if name.endswith("_rate") else 1))
        if history[names].isna().all(axis=None):
            axis.set_yticks([])
            axis.text(0.5, 0.5, "no episode ended", transform=axis.transAxes, ha="center", va="center", color=QUIET)
        elif len(names) > 1:
            axis.legend(loc="center right", handlelength=1.0, fontsize=8)
        axis.set_title(label, fontweight="normal")
        axis.grid(axis="y")
        _stage_lines(axis, history["stage"].to_numpy(), decisions)
    figure.supxlabel(f"decisions [{unit_name}]", fontsize=STYLE["axes.labelsize"])
    return figure


def _learning_curve(axis: Axes, decisions: np.ndarray, values: pd.Series) -> None:
    name = str(values.name).removesuffix("_rate")
    color = {"collision": OUTCOME_COLORS["collision"], "timeout": QUIET}.get(name, ADAPTIVE_COLOR)
    smooth = values.rolling(max(len(values) // 30, 1), min_periods=1, center=True).mean()
    axis.plot(decisions, values, color=color, alpha=0.35, linewidth=0.7)
    alone = "o" if values.count() == 1 else None  # a single value makes no line
    axis.plot(decisions, smooth, color=color, linewidth=1.8, label=name, marker=alone)


def _two_columns(n_panels: int, row_height_in: float) -> tuple[Figure, list[Axes]]:
    """A figure of n_panels axes in two columns; a spare one is removed."""
    n_rows = math.ceil(n_panels / 2)
    figure = Figure((WIDTH_IN, 0.4 + row_height_in * n_rows), layout="constrained")
    axes = list(figure.subplots(n_rows, 2, squeeze=False).flat)
    for axis in axes[n_panels:]:
        axis.remove()
    return figure, axes[:n_panels]


def _stage_lines(axis: Axes, stage: np.ndarray, decisions: np.ndarray) -> None:
    for row in np.flatnonzero(stage[1:] != stage[:-1]) + 1:
        axis.axvline(decisions[row], color=QUIET, linestyle="--", linewidth=0.8)


@styled
def render(figure: Figure, format_: str) -> bytes:
    """The figure as svg, pdf or png (200 dpi); the same bytes for the same data."""
    buffer = BytesIO()
    timestamp = {"svg": "Date", "pdf": "CreationDate"}.get(format_)
    figure.savefig(buffer, format=format_, metadata={timestamp: None} if timestamp else None)
    return buffer.getvalue()


def settings_and_planners(table: pd.DataFrame) -> tuple[list[str], list[str]]:
    """Settings and planners in the order of the table."""
    return list(table["setting"].unique()), list(table["planner"].unique())


def _settings(traces: Sequence[Trace]) -> list[str]:
    return list(dict.fromkeys(trace.setting for trace in traces))


def _planner_legend(figure: Figure, colors: Mapping[str, str], fixed_s: FixedHorizons) -> None:
    handles = [
        Line2D([], [], color=color, linewidth=2.2 if name == ADAPTIVE else 1.2, label=planner_label(name, fixed_s))
        for name, color in colors.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)


def _horizon_legend(
    figure: Figure, levels: np.ndarray, others: Sequence[Line2D | Patch] = (), n_columns: int = 4
) -> None:
    handles = [Patch(color=horizon_color(level), label=f"horizon {horizon_label(level)}") for level in levels]
    figure.legend(handles=[*handles, *others], loc="outside upper center", ncols=n_columns, handlelength=1.2)
