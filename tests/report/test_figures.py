"""Figures show the numbers they are given, with units, and always the same way."""

import re
from collections.abc import Callable

import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from measured import FIXED_S

from negopipe.evaluation.metrics import behaviour_index
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.report import figures, labels, outcome_figures, style

Draw = Callable[[list[Trace], pd.DataFrame, pd.DataFrame], Figure]

DRAWINGS: dict[str, Draw] = {
    "comparison": lambda traces, table, history: figures.comparison(table, FIXED_S),
    "outcomes": lambda traces, table, history: outcome_figures.outcomes(table, FIXED_S),
    "success_by_style": lambda traces, table, history: outcome_figures.success_by_style(table, FIXED_S),
    "arrivals": lambda traces, table, history: outcome_figures.arrivals(table, FIXED_S),
    "outcome_map": lambda traces, table, history: outcome_figures.outcome_map(table, "Yield", [(12.2, 12.6)]),
    "behaviour": lambda traces, table, history: figures.behaviour(traces, FIXED_S),
    "horizons": lambda traces, table, history: figures.horizons(traces),
    "horizons_along": lambda traces, table, history: figures.horizons_along(traces),
    "space_time": lambda traces, table, history: figures.space_time(traces[:5], 0, FIXED_S),
    "training": lambda traces, table, history: figures.training(history),
}


@pytest.mark.parametrize("name", DRAWINGS)
def test_every_quantity_has_its_unit(
    name: str, traces: list[Trace], table: pd.DataFrame, history: pd.DataFrame
) -> None:
    figure = DRAWINGS[name](traces, table, history)
    axis_labels = [label for axis in figure.axes for label in (axis.get_xlabel(), axis.get_ylabel()) if label]
    axis_labels += [figure.get_supxlabel()] if figure.get_supxlabel() else []
    assert axis_labels
    assert all(re.search(r"\[.+\]", label) for label in axis_labels)
    if name == "training":  # panels are titled with what they show instead
        assert all(re.search(r"\[.+\]", axis.get_title(loc="left")) for axis in figure.axes)


@pytest.mark.parametrize(
    "name", [name if name == "comparison" else pytest.param(name, marks=pytest.mark.slow) for name in DRAWINGS]
)
def test_the_same_data_give_the_same_bytes(
    name: str, traces: list[Trace], table: pd.DataFrame, history: pd.DataFrame
) -> None:
    first, second = (figures.render(DRAWINGS[name](traces, table, history), "svg") for _ in range(2))
    assert first == second
    assert first.startswith(b"<?xml")


def test_formats_are_what_they_are_called(table: pd.DataFrame) -> None:
    figure = outcome_figures.outcomes(table, FIXED_S)
    assert figures.render(figure, "png").startswith(b"\x89PNG")
    assert figures.render(figure, "pdf").startswith(b"%PDF")


def test_style_does_not_leak(table: pd.DataFrame) -> None:
    before = matplotlib.rcParams["svg.hashsalt"], matplotlib.rcParams["axes.spines.top"]
    figures.render(outcome_figures.outcomes(table, FIXED_S), "svg")
    assert (matplotlib.rcParams["svg.hashsalt"], matplotlib.rcParams["axes.spines.top"]) == before


def test_a_planner_keeps_its_colour_whoever_it_is_shown_with() -> None:
    together = style.planner_colors(["adaptive", "fixed_0", "random", "fixed_4", "level_k", "rule", "rule"], FIXED_S)
    assert together["fixed_4"] == style.horizon_color(4.0)
    for name in ("adaptive", "fixed_4", "level_k"):
        assert style.planner_colors([name], FIXED_S) == {name: together[name]}
    assert len(set(together.values())) == 6


def test_a_planners_name_tells_nothing_of_its_horizon() -> None:
    fixed_s = {"bold": 0.0, "fixed_2": 6.0, "fixed_2.5": 2.5, "random": 4.0}
    colors = style.planner_colors([*fixed_s, "fixed_0"], fixed_s)
    assert [colors[name] for name in fixed_s] == [style.horizon_color(horizon_s) for horizon_s in fixed_s.values()]
    assert colors["fixed_0"] not in [colors[name] for name in fixed_s]
    names = [labels.planner_label(name, fixed_s).replace("\N{NO-BREAK SPACE}", "~") for name in (*fixed_s, "fixed_0")]
    assert names == ["bold (0~s)", "fixed 2 (6~s)", "fixed 2.5~s", "random (4~s)", "fixed 0"]


def test_comparison_prints_the_means(table: pd.DataFrame) -> None:
    figure = figures.comparison(table, FIXED_S)
    printed = [text.get_text() for text in figure.axes[2].texts]  # second row, first setting: driving time
    rows = table[table["setting"] == table["setting"].iloc[0]]
    means = rows.groupby("planner", sort=False)["driving_time_s"].mean()
    assert printed == ["none" if np.isnan(mean) else f"{mean:.1f}" for mean in means]
    assert "none" in printed
    assert printed[0] != "none"


def test_bars_of_outcomes_are_the_shares(table: pd.DataFrame) -> None:
    axis = outcome_figures.outcomes(table, FIXED_S).axes[0]
    rows = table[table["setting"] == table["setting"].iloc[0]]
    for planner_row, planner in enumerate(rows["planner"].unique()):
        outcome = rows[rows["planner"] == planner]["outcome"]
        for container, name in zip(axis.containers, OUTCOMES, strict=True):
            assert container[planner_row].get_width() == pytest.approx(100 * (outcome == name).mean())


def test_arrival_curves_are_the_shares_by_time(table: pd.DataFrame) -> None:
    figure = outcome_figures.arrivals(table, FIXED_S)
    setting = table["setting"].unique()[0]
    rows = table[(table["setting"] == setting) & (table["planner"] == "adaptive")]
    curve = next(line for line in figure.axes[0].lines if line.get_linewidth() > 2)
    x, y = (np.asarray(data, dtype=float) for data in (curve.get_xdata(), curve.get_ydata()))
    for time_s in (5.0, 10.0, 20.0):
        assert y[x <= time_s][-1] == pytest.approx(100 * (rows["ego_time_s"] <= time_s).mean())


def test_outcome_map_fills_each_column_with_its_outcomes(table: pd.DataFrame) -> None:
    one = table[(table["setting"] == "yield") & (table["planner"] == "adaptive")].assign(style_horizon_s=2.0)
    figure = outcome_figures.outcome_map(one, "Yield", [])
    bars = [patch for patch in figure.axes[0].patches if patch.get_height() != 0]
    by_column: dict[float, float] = {}
    for bar in bars:
        by_column[round(bar.get_x(), 3)] = by_column.get(round(bar.get_x(), 3), 0.0) - bar.get_height()
    assert by_column
    assert list(by_column.values()) == pytest.approx([0.76] * len(by_column))
    distance = one["social_start_distance_m"]
    assert all(((distance >= x - 1e-3) & (distance <= x + outcome_figures.BIN_M + 1e-3)).any() for x in by_column)


def test_training_maps_show_each_part_on_the_same_axes(driven: pd.DataFrame) -> None:
    starts, maps = zip(*outcome_figures.training_maps(driven, [], 4), strict=True)
    assert list(starts) == [round(i * driven["decisions"].max() / 4) for i in range(4)]
    assert len({figure.axes[0].get_xlim() for figure in maps}) == 1
    first = driven[driven["decisions"] <= starts[1]]
    heights: dict[str, float] = {}
    for bar in maps[0].axes[0].patches:
        color = to_hex(bar.get_facecolor()).upper()
        heights[color] = heights.get(color, 0.0) - bar.get_height()
    crashes = style.OUTCOME_COLORS["collision"]
    column = np.floor(first["social_start_distance_m"] / outcome_figures.BIN_M).astype(int)
    shares = first.groupby(["style_horizon_s", column])["is_collision"].mean()
    assert heights[crashes] == pytest.approx(0.76 * shares.sum())
    one_style = driven[(driven["style_horizon_s"] == 2) | (driven["decisions"] > starts[1])]
    assert next(outcome_figures.training_maps(one_style, [], 4))[1].axes  # nothing of a style in a part


def test_behaviour_draws_the_median_index_in_degrees(traces: list[Trace]) -> None:
    axis = figures.behaviour(traces, FIXED_S).axes[0]
    adaptive = next(line for line in axis.lines if to_hex(line.get_color()) == style.ADAPTIVE_COLOR.lower())
    psi = np.degrees(behaviour_index(traces[0]))
    n_drawn = len(adaptive.get_ydata())
    np.testing.assert_allclose(adaptive.get_ydata(), np.nanmedian(psi[:n_drawn], axis=1))
    assert np.isfinite(psi[n_drawn - 1]).mean() >= 0.25
    assert n_drawn == len(psi) or np.isfinite(psi[n_drawn]).mean() < 0.25


def test_horizons_fill_exactly_the_running_episodes(traces: list[Trace]) -> None:
    axis = figures.horizons(traces).axes[0]
    outline = axis.patches[-1].get_data().values
    is_running = np.arange(len(traces[0].reward))[:, None] < traces[0].n_steps
    np.testing.assert_allclose(outline, 100 * is_running.mean(1))


def test_space_time_colours_the_ego_by_its_horizon(traces: list[Trace]) -> None:
    figure = figures.space_time(traces[:5], 0, FIXED_S)
    for axis, trace in zip(figure.axes, traces[:5], strict=True):
        colors = [to_hex(color) for color in axis.collections[-1].get_colors()]
        horizon = trace.horizon_s[: trace.n_steps[0], 0, 0]
        assert colors == [style.horizon_color(value) for value in horizon]
        assert OUTCOMES[trace.outcome[0]] in axis.get_title(loc="left")


def test_training_draws_only_what_was_logged_and_marks_the_stages(history: pd.DataFrame) -> None:
    figure = figures.training(history.drop(columns=["kl", "value_loss"]))
    assert [axis.get_title(loc="left") for axis in figure.axes] == [
        "episodes [%]",
        "return [reward]",
        "policy entropy [nat]",
        "speed [decisions/s]",
    ]
    boundaries = [line.get_xdata()[0] for line in figure.axes[1].lines if line.get_linestyle() == "--"]
    begins = history["decisions"][history["stage"] != history["stage"].shift(fill_value="apart")] / 1e3
    assert boundaries == pytest.approx(begins.tolist())


def test_training_says_where_no_episode_ended(history: pd.DataFrame) -> None:
    episodes = ["success_rate", "collision_rate", "timeout_rate", "return_mean"]
    assert not any(axis.texts for axis in figures.training(history).axes)
    figure = figures.training(history.assign(**dict.fromkeys(episodes, np.nan)))
    assert [[text.get_text() for text in axis.texts] for axis in figure.axes][:3] == [["no episode ended"]] * 2 + [[]]


def test_a_single_value_of_a_training_is_seen(history: pd.DataFrame) -> None:
    alone = history["return_mean"].where(history.index == history.index[-1])
    figure = figures.training(history.assign(return_mean=alone))
    markers = [[line.get_marker() for line in axis.lines if line.get_alpha() is None] for axis in figure.axes[:2]]
    assert "o" in markers[1]
    assert "o" not in markers[0]


def test_horizons_along_the_road_are_shares_of_the_decisions_there(traces: list[Trace]) -> None:
    axis = figures.horizons_along(traces).axes[0]
    adaptive = traces[0]
    reached = adaptive.reached_step[:, 0]
    is_running = np.arange(len(adaptive.reward))[:, None] < np.where(reached < 0, adaptive.n_steps, reached)
    place = adaptive.progress_m[:-1, :, 0][is_running]
    horizon = adaptive.horizon_s[:, :, 0][is_running]
    levels = np.unique(np.concatenate([t.horizon_s[:, :, 0].ravel() for t in traces if t.planner == "adaptive"]))
    tops = {level: stairs.get_data() for level, stairs in zip(levels, axis.patches, strict=True)}
    top, edges, base = tops[6.0]
    for left, high, low in zip(edges[:-1], top, base, strict=True):
        there = horizon[(place >= left) & (place < left + 1)]
        assert high - low == pytest.approx(100 * (there == 6.0).mean() if len(there) else 0.0)


def test_arrivals_are_drawn_where_there_are_none(table: pd.DataFrame) -> None:
    figure = outcome_figures.arrivals(table.assign(ego_time_s=np.nan), FIXED_S)
    assert all(line.get_ydata().max() == 0 for axis in figure.axes for line in axis.lines)
