"""An infinite horizon in figures: its own colour, its sign, and a ribbon as long as a plan."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from measured import FIXED_S

from negopipe.evaluation.behaviour_map import BEHAVIOUR_MAP, trends
from negopipe.evaluation.names import fixed_name, in_words
from negopipe.evaluation.trace import Trace
from negopipe.report import figures, map_figure, outcome_figures, style
from negopipe.report.animation import _Film
from negopipe.report.labels import planner_label
from negopipe.report.scene import Scene

SIGN = "\N{INFINITY}"
FIXED = {**FIXED_S, "fixed_inf": math.inf, "polite": math.inf}


def test_it_has_a_name_and_a_label() -> None:
    assert fixed_name(math.inf) == "fixed_inf"
    assert [in_words(name, FIXED) for name in ("fixed_inf", "polite")] == ["fixed inf", "polite (inf)"]
    assert [planner_label(name, FIXED) for name in ("fixed_inf", "polite")] == [f"fixed {SIGN}", f"polite ({SIGN})"]
    assert planner_label("inf", FIXED) == "inf"  # a planner of another kind


def test_its_colour_is_none_of_the_others() -> None:
    planners = ["adaptive", "random", "cautious", *FIXED]
    colors = style.planner_colors(planners, FIXED)
    assert colors["fixed_inf"] == colors["polite"] == style.horizon_color(math.inf)
    others = [color for name, color in colors.items() if not math.isinf(FIXED.get(name, 0.0))]
    assert colors["fixed_inf"] not in others


def with_infinite(trace: Trace) -> Trace:
    """The trace with an infinite horizon instead of one of 6 s."""
    return replace(trace, horizon_s=np.where(trace.horizon_s == 6.0, np.float32(np.inf), trace.horizon_s))


def test_legends_and_lines_show_it(traces: list[Trace]) -> None:
    changed = [with_infinite(trace) for trace in traces]
    some = next(trace for trace in changed if np.isinf(trace.horizon_s[0, 0, 0]))
    figure = figures.space_time([some], 0, FIXED)
    assert f"horizon {SIGN}" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert style.QUIET not in [to_hex(color).upper() for color in figure.axes[0].collections[-1].get_colors()]
    adaptive = [trace for trace in changed if trace.planner == "adaptive"]
    for drawing in (figures.horizons(adaptive), figures.horizons_along(adaptive)):
        labels = [text.get_text() for text in drawing.legends[0].get_texts()]
        assert labels[-1] == f"horizon {SIGN}"


def test_the_ribbon_is_as_long_as_a_plan(traces: list[Trace], scene: Scene) -> None:
    trace = replace(traces[0], horizon_s=np.full_like(traces[0].horizon_s, np.inf))
    for plan_s in (2.0, 6.0):
        panel = _Film([trace], 0, replace(scene, plan_s=plan_s), FIXED).panels[0]
        panel.artists_at(1.0)
        assert panel.view.horizon.get_text() == f"horizon {SIGN}"
        length_m = np.ptp(panel.view.ribbons[0].get_xy()[:, 0])
        assert length_m == pytest.approx(plan_s * trace.speed_mps[5, 0, 1], abs=1e-4)


def test_maps_of_styles_have_a_row_for_it(table: pd.DataFrame) -> None:
    styled = table.assign(style_horizon_s=np.where(table["style_horizon_s"] == 6.0, np.inf, table["style_horizon_s"]))
    one = styled.assign(setting="push", style_horizon_s=np.resize([2.0, np.inf], len(styled)))
    axis = outcome_figures.success_by_style(one, FIXED).axes[0]
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["2", SIGN]
    axis = outcome_figures.outcome_map(one[one["planner"] == "adaptive"], "Push", []).axes[0]
    assert [tick.get_text() for tick in axis.get_yticklabels()] == ["2", SIGN]


def test_the_behaviour_map_has_a_cell_for_it_and_claim_8_leaves_it_out() -> None:
    rows = [
        {**dict.fromkeys(BEHAVIOUR_MAP.columns, 0.0), "setting": "push", "ego_horizon_s": ego, "social_style_s": social,
         "n_episodes": 2, "success_rate": 1.0, "ego_passes_first_rate": first, "smallest_gap_m": 1.0}
        for ego, first in ((0.0, 1.0), (6.0, 0.5), (math.inf, 0.9)) for social in (2.0, math.inf)
    ]  # fmt: skip
    table = pd.DataFrame(rows)
    figure = map_figure.behaviour_map(table)
    figures.render(figure, "png")
    for axis, expected in ((figure.axes[0].xaxis, ["0", "6", SIGN]), (figure.axes[0].yaxis, ["2", SIGN])):
        assert [tick.get_text() for tick in axis.get_ticklabels()] == expected
    found = trends(table)
    assert {finding.verdict for finding in found if finding.measure == "ego_passes_first_rate"} == {"holds"}
    assert f"push against 2 s, {SIGN}" in map_figure.reading(found)
