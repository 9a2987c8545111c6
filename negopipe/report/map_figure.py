"""The behaviour map as a figure, and claim 8 as a paragraph."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from negopipe.evaluation.behaviour_map import EQUAL, FAILS, HOLDS, UNKNOWN, Trend
from negopipe.report.figures import outcome_legend
from negopipe.report.labels import horizon_label, horizon_number, setting_label
from negopipe.report.style import INK, OUTCOME_COLORS, STYLE, WIDTH_IN, styled

RATES = {
    "success": "success_rate",
    "collision": "collision_rate",
    "deadlock": "deadlock_rate",
    "timeout": "other_timeout_rate",
    "social_collision": "social_collision_rate",
}
"""Outcome -> its column, in the order of the parts of a cell."""

FIRST_COLORMAP = LinearSegmentedColormap.from_list("first", ["#F2DDA8", "#E4DFEA", "#56409A"])
"""Ego's share of first passages, from sand (0 %) to violet (100 %), distinct under colour vision deficiencies."""
OPPONENT_LABEL = {
    False: "prediction horizon of the social driver [s]",
    True: "social driver: prediction horizon [s] or name",
}
"""Label of an axis of styles, and of one with drivers of a population."""
NO_PASSAGE = "#EDEDED"

SMALLEST_PART = 0.3
"""Share of a cell's height that a number needs."""


@styled
def behaviour_map(table: pd.DataFrame) -> Figure:
    """Two maps per setting over the ego's horizon and its opponent: outcomes, and first passages.

    The opponents are the styles of the social driver, below the drivers of the population by name.

    Left: the parts of a cell are the shares of the outcomes. Right: the colour and the upper number are the ego's share
    of first passages (none: there was no passage), the lower number is the mean smallest gap.
    """
    settings = list(table["setting"].unique())
    horizons, styles = (sorted(table[axis].dropna().unique()) for axis in ("ego_horizon_s", "social_style_s"))
    table = table.assign(opponent=_opponent(table))
    drivers = list(table.loc[table["social_style_s"].isna(), "opponent"].unique())
    opponents = [*styles, *drivers]
    height = 0.9 + len(settings) * (0.35 + 0.44 * len(opponents))
    figure = Figure((WIDTH_IN, height), layout="constrained")
    axes = figure.subplots(len(settings), 2, sharex=True, sharey=True, squeeze=False)
    font_size = min(8.0, 34 / len(horizons))
    for (left, right), setting in zip(axes, settings, strict=True):
        rows = table[table["setting"] == setting]
        _outcome_cells(left, rows, horizons, opponents, font_size)
        _passage_cells(right, rows, horizons, opponents, font_size)
        left.set_title(f"{setting_label(setting)}: outcomes [%]")
        right.set_title("ego passes first [%], gap [m]", fontweight="normal", loc="right" if drivers else "left")
        for axis in (left, right):
            _frame(axis, horizons, opponents)
    figure.supxlabel("prediction horizon of the ego [s]", fontsize=STYLE["axes.labelsize"])
    figure.supylabel(OPPONENT_LABEL[bool(drivers)], fontsize=STYLE["axes.labelsize"])
    outcome_legend(figure, [outcome for outcome, rate in RATES.items() if table[rate].any()])
    return figure


def _opponent(table: pd.DataFrame) -> pd.Series:
    """Whom the ego meets in each row: the style in s, or the driver's name where it has no style."""
    styles = table["social_style_s"].astype(object)
    return styles.where(styles.notna(), table["social_driver"]) if "social_driver" in table else styles


def _outcome_cells(
    axis: Axes, rows: pd.DataFrame, horizons: list[float], opponents: list[float | str], font_size: float
) -> None:
    for row in rows.to_dict("records"):
        left, bottom = horizons.index(row["ego_horizon_s"]) - 0.5, opponents.index(row["opponent"]) - 0.5
        for outcome, column in RATES.items():
            share = row[column]
            axis.add_patch(Rectangle((left, bottom), 1, share, color=OUTCOME_COLORS[outcome], linewidth=0))
            if share >= SMALLEST_PART:
                color = "white" if outcome == "deadlock" else INK
                _number(axis, left + 0.5, bottom + share / 2, f"{100 * share:.0f}", color, font_size)
            bottom += share


def _passage_cells(
    axis: Axes, rows: pd.DataFrame, horizons: list[float], opponents: list[float | str], font_size: float
) -> None:
    first, gap = (
        rows.pivot_table(index="opponent", columns="ego_horizon_s", values=measure, dropna=False, sort=False)
        .reindex(index=opponents, columns=horizons)
        .to_numpy()
        for measure in ("ego_passes_first_rate", "smallest_gap_m")
    )
    axis.imshow(first, cmap=FIRST_COLORMAP.with_extremes(bad=NO_PASSAGE), vmin=0, vmax=1, aspect="auto", origin="lower")
    for (row, column), share in np.ndenumerate(first):
        color = "white" if share > 0.7 else INK
        text, size = ("none", 0.85 * font_size) if np.isnan(share) else (f"{100 * share:.0f}", font_size)
        _number(axis, column, row + 0.2, text, color, size)
        _number(axis, column, row - 0.22, f"{gap[row, column]:.2f} m", color, 0.85 * font_size)


def _opponent_text(opponent: float | str) -> str:
    return opponent.replace("_", "\n") if isinstance(opponent, str) else horizon_number(opponent)


def _number(axis: Axes, x: float, y: float, text: str, color: str, font_size: float) -> None:
    axis.text(x, y, text, ha="center", va="center_baseline", color=color, fontsize=font_size)


def _frame(axis: Axes, horizons: list[float], opponents: list[float | str]) -> None:
    """Ticks at the cells' middles, white lines between the cells."""
    axis.set_xticks(range(len(horizons)), [horizon_number(horizon) for horizon in horizons])
    axis.set_yticks(range(len(opponents)), [_opponent_text(each) for each in opponents])
    axis.set_xticks(np.arange(len(horizons) + 1) - 0.5, minor=True)
    axis.set_yticks(np.arange(len(opponents) + 1) - 0.5, minor=True)
    axis.grid(which="minor", color="white", linewidth=2)
    axis.tick_params(which="both", length=0)
    axis.spines[:].set_visible(False)
    axis.set(xlim=(-0.5, len(horizons) - 0.5), ylim=(-0.5, len(opponents) - 0.5))


MEASURES = {"ego_passes_first_rate": "more first passages", "smallest_gap_m": "smaller gap"}
VERDICTS = {HOLDS: "holds in", EQUAL: "makes no difference in", FAILS: "does not hold in", UNKNOWN: "is undecided in"}


def reading(found: Sequence[Trend]) -> str:
    """Claim 8 in one paragraph: the cases in which it holds and in which it does not."""
    parts = [_sentence(words, [f for f in found if f.measure == measure]) for measure, words in MEASURES.items()]
    return "Claim 8, that a shorter prediction horizon of the ego gives more aggressive driving. " + " ".join(parts)


def _sentence(words: str, found: Sequence[Trend]) -> str:
    clauses = []
    for verdict, says in VERDICTS.items():
        cases = [finding for finding in found if finding.verdict == verdict]
        if cases:
            clauses.append(f"{says} {len(cases)} of {len(found)} ({_cases(cases)})")
    return f"{words.capitalize()}: {', '.join(clauses)}."


def _cases(found: Sequence[Trend]) -> str:
    by_setting: dict[str, list[str]] = {}
    for finding in found:
        by_setting.setdefault(finding.setting, []).append(f"{horizon_label(finding.social_style_s)}{_turn(finding)}")
    return "; ".join(f"{setting} against {', '.join(styles)}" for setting, styles in by_setting.items())


def _turn(finding: Trend) -> str:
    if finding.turn is None:
        return ""
    (horizon_s, value), (longer_s, then) = finding.turn
    horizon, longer = horizon_label(horizon_s), horizon_label(longer_s)
    if finding.measure == "ego_passes_first_rate":
        return f" [{100 * value:.0f} % at {horizon} but {100 * then:.0f} % at {longer}]"
    return f" [{value:.2f} m at {horizon} but {then:.2f} m at {longer}]"
