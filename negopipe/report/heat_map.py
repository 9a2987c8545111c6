"""Cells of a heat map with their numbers."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from negopipe.report.style import INK

DARK = 0.55
"""Share of the colours from which numbers are white."""
EMPTY = "#EDEDED"
"""Colour of a cell without a value."""


def heat_cells(
    axis: Axes,
    values: np.ndarray,
    colors: str,
    scale: Sequence[float],
    text: str,
    font_size: float = 7.5,
    below: np.ndarray | None = None,
) -> None:
    """Colour the cells `values` [rows, columns] and write their numbers; NaN leaves a cell grey.

    scale: values of the palest and the darkest colour
    text: format of a number
    below: [rows, columns] str, written smaller under the numbers
    """
    low, high = scale
    axis.set_facecolor(EMPTY)
    axis.imshow(np.ma.masked_invalid(values), cmap=colors, vmin=low, vmax=high, aspect="auto")
    rise = 0.0 if below is None else 0.16
    for (row, column), value in np.ndenumerate(values):
        if np.isnan(value):
            continue
        color = "white" if value - low > DARK * (high - low) else INK
        axis.text(column, row - rise, text.format(value), ha="center", va="center", color=color, fontsize=font_size)
        if below is not None:
            small = 0.75 * font_size
            axis.text(
                column, row + 0.22, str(below[row, column]), ha="center", va="center", color=color, fontsize=small
            )
    axis.grid(visible=False)
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
