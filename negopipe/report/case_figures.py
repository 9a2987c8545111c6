"""Heat maps of the cases of unseen-v1: a row per case, a column per planner."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from negopipe.report.style import INK, WIDTH_IN, styled

MAPS = {
    "success_rate": ("success", "Blues", (40.0, 130.0), 0),
    "collision_rate": ("collision", "Oranges", (0.0, 30.0), 1),
}
"""Column of the table of cases -> its name, colours, values of the palest and the darkest colour, decimals."""
DARK = 0.55
"""Share of the colours from which numbers are white."""


@styled
def case_map(table: pd.DataFrame, column: str, labels: Mapping[str, str]) -> Figure:
    """A rate of every planner in every case.

    table: rows of unseen.csv; column: of `MAPS`
    labels: planner -> its name on the figure, in the order of the columns
    """
    name, colors, scale, decimals = MAPS[column]
    cases = list(table["case"].unique())
    rate = 100 * table.pivot(index="case", columns="planner", values=column).reindex(cases)[list(labels)]
    figure = Figure((WIDTH_IN, 1.1 + 0.2 * len(cases)), layout="constrained")
    axis = figure.subplots()
    _cells(axis, rate, colors, scale, decimals)
    axis.set_title(f"{name} [%]")
    axis.set_xticks(range(len(labels)), list(labels.values()), rotation=90)
    axis.set_yticks(range(len(cases)), [case.replace("_", " ") for case in cases])
    return figure


def _cells(axis: Axes, rate: pd.DataFrame, colors: str, scale: Sequence[float], decimals: int) -> None:
    low, high = scale
    axis.imshow(rate, cmap=colors, vmin=low, vmax=high, aspect="auto")
    for (row, column), value in np.ndenumerate(rate.to_numpy()):
        text = "" if np.isnan(value) else f"{value:.{decimals}f}"
        color = "white" if value - low > DARK * (high - low) else INK
        axis.text(column, row, text, ha="center", va="center", color=color, fontsize=7.5)
    axis.tick_params(length=0, labelsize=8)
    axis.spines[:].set_visible(False)
