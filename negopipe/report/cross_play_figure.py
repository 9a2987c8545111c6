"""Cross-play as heat maps: a row per driver of the ego, a column per driver on the other side."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from negopipe.report.heat_map import heat_cells
from negopipe.report.labels import setting_label
from negopipe.report.style import WIDTH_IN, styled

MAPS = {
    "success": ("success [%]", "Blues", (40.0, 130.0)),
    "collision": ("collision [%]", "Oranges", (0.0, 30.0)),
    "ego_first": ("ego passes first [%]", "Purples", (0.0, 150.0)),
}
"""Share in the table -> its title, colours, values of the palest and the darkest colour."""
WIDE = 2.0
"""Width of an interval in percent from which its decimals say nothing."""


@styled
def cross_play(table: pd.DataFrame) -> Figure:
    """Shares of success, collisions and first passages of every pair, each over its score interval.

    table: rows of cross_play.csv of one setting
    """
    players = list(table["ego"].unique())
    labels = [player.replace("_", " ") for player in players]
    figure = Figure((WIDTH_IN, len(MAPS) * (0.5 + 0.34 * len(players)) + 1.0), layout="constrained")
    for axis, name in zip(figure.subplots(len(MAPS), sharex=True, squeeze=False)[:, 0], MAPS, strict=True):
        _draw(axis, table, players, name)
        axis.set_yticks(range(len(players)), labels)
        axis.set_xticks(range(len(players)), labels, rotation=0 if len(players) < 4 else 90)
        axis.set_ylabel("ego")
    axis.set_xlabel("social driver")
    figure.suptitle(setting_label(str(table["setting"].iloc[0])))
    return figure


def _draw(axis: Axes, table: pd.DataFrame, players: list[str], name: str) -> None:
    title, colors, scale = MAPS[name]
    value, low, high = (
        100 * table.pivot(index="ego", columns="social", values=f"{name}_{part}").loc[players, players].to_numpy()
        for part in ("rate", "low", "high")
    )
    texts = [_interval(*bounds) for bounds in zip(low.flat, high.flat, strict=True)]
    between = np.array(texts).reshape(value.shape)
    heat_cells(axis, value, colors, scale, "{:.1f}", min(8.0, 60 / len(players)), between)
    axis.set_title(title)


def _interval(low: float, high: float) -> str:
    """A narrow interval with a decimal, unless that is 0; a wide one without."""
    decimals = 1 if high - low < WIDE else 0
    return "\N{EN DASH}".join(f"{each:.{decimals}f}".removesuffix(".0") for each in (low, high))
