"""The figure of a sweep: a line per config through an axis per key, the objective last and as colour."""

import math
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from negopipe.report.style import INK, QUIET, styled

AXIS_IN, HEIGHT_IN = 1.35, 3.6
LOG_RATIO = 30.0
"""An axis of positive numbers is logarithmic from this ratio of the largest to the smallest on."""
_LETTERS = 14


@styled
def parallel_coordinates(table: pd.DataFrame, keys: Sequence[str], objective: str, minimize: bool = False) -> Figure:
    """Rows of `table` as lines over the columns `keys` and `objective`; the best one is drawn last and thick.

    Numbers have an axis with their range, all else has its values in order. Rows without an objective are left out.
    """
    rows = table[table[objective].notna()].sort_values(objective, ascending=not minimize)
    names = [*keys, objective]
    heights, colors = np.empty((len(rows), len(names))), matplotlib.colormaps["viridis_r" if minimize else "viridis"]
    figure = Figure((1.2 + AXIS_IN * len(names), HEIGHT_IN), layout="constrained")
    axis = figure.subplots()
    for column, name in enumerate(names):
        height, ticks = _scale(rows[name].tolist())
        is_crowded = len(set(height)) < len(height)  # lines that meet there stay apart, the better above
        heights[:, column] = height + (np.linspace(-0.035, 0.035, len(height)) if is_crowded else 0.0)
        _draw_axis(axis, column, ticks, is_last=column == len(names) - 1)
    tint = Normalize(-0.02, 1.12)  # neither end of the colours is lost on white
    for i, line in enumerate(heights):
        is_best = i == len(heights) - 1
        color = colors(tint(heights[i, -1]))
        axis.plot(line, color=color, linewidth=2.8 if is_best else 1.2, alpha=1.0 if is_best else 0.75, zorder=2 + i)
    axis.set(xlim=(-0.35, len(names) - 0.4), ylim=(-0.05, 1.05))
    axis.set_xticks(range(len(names)), [_label(name) for name in names])
    axis.set_yticks([])
    axis.set_title(
        "A line per config, coloured by its objective; the thick one is the best", fontweight="normal", pad=12
    )
    axis.tick_params(axis="x", length=0, pad=8)
    axis.spines[:].set_visible(False)
    return figure


def _scale(values: list[Any]) -> tuple[np.ndarray, dict[float, str]]:
    """Heights in [0, 1] of the values on their axis, and its ticks: label by height."""
    if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return _ranks(values)
    numbers = np.array(values, dtype=float)
    low, high = numbers.min(), numbers.max()
    if low == high:
        return np.full(len(numbers), 0.5), {0.5: f"{low:.4g}"}
    is_log = low > 0 and high / low >= LOG_RATIO
    if len(set(values)) <= 5:
        marks = np.unique(numbers)
    else:
        marks = np.geomspace(low, high, 5) if is_log else np.linspace(low, high, 5)
    line = np.log if is_log else np.asarray
    start, end = line(low), line(high)
    ticks = {float((line(mark) - start) / (end - start)): f"{mark:.3g}" for mark in marks}
    return (line(numbers) - start) / (end - start), ticks


def _ranks(values: list[Any]) -> tuple[np.ndarray, dict[float, str]]:
    texts = [_short(value) for value in values]
    order = {text: i for i, text in enumerate(sorted(set(texts)))}
    span = max(len(order) - 1, 1)
    base = 0.5 if len(order) == 1 else 0.0
    return np.array([base + order[text] / span for text in texts]), {base + i / span: t for t, i in order.items()}


def _draw_axis(axis: Axes, column: int, ticks: dict[float, str], is_last: bool) -> None:
    axis.plot([column, column], [0, 1], color=QUIET, linewidth=0.8, zorder=1)
    for height, text in ticks.items():
        axis.plot([column - 0.03, column + 0.03], [height, height], color=QUIET, linewidth=0.8, zorder=1)
        x, side = (column + 0.06, "left") if is_last else (column - 0.06, "right")
        box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.6}
        axis.text(x, height, text, ha=side, va="center", fontsize=8, color=INK, bbox=box, zorder=1000)


def _label(key: str) -> str:
    """The key's last part, below it where it stands."""
    group, _, name = key.rpartition(".")
    return "\n".join([*_broken(name, "_"), *(f"({part})" for part in _broken(group, ".") if part)])


def _broken(text: str, at: str) -> list[str]:
    """In lines of a width that fits below an axis."""
    lines: list[str] = []
    for part in (piece + at for piece in text.split(at)):
        if lines and len(lines[-1]) + len(part) <= _LETTERS + 2:
            lines[-1] += part
        else:
            lines.append(part)
    return [line if i < len(lines) - 1 else line.removesuffix(at) for i, line in enumerate(lines)]


def _short(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "none", True: "true", False: "false"}[value]
    text = f"{value:.4g}" if isinstance(value, float) and math.isfinite(value) else str(value)
    return text if len(text) <= _LETTERS else f"{text[: _LETTERS - 1]}…"
