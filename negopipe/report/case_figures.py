"""Heat maps of the cases of unseen-v1: a row per case, a column per planner."""

from collections.abc import Mapping

import pandas as pd
from matplotlib.figure import Figure

from negopipe.report.heat_map import heat_cells
from negopipe.report.style import WIDTH_IN, styled

MAPS = {
    "success_rate": ("success", "Blues", (40.0, 130.0), 0),
    "collision_rate": ("collision", "Oranges", (0.0, 30.0), 1),
}
"""Column of the table of cases -> its name, colours, values of the palest and the darkest colour, decimals."""


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
    heat_cells(axis, rate.to_numpy(), colors, scale, f"{{:.{decimals}f}}")
    axis.tick_params(labelsize=8)
    axis.set_title(f"{name} [%]")
    axis.set_xticks(range(len(labels)), list(labels.values()), rotation=90)
    axis.set_yticks(range(len(cases)), [case.replace("_", " ") for case in cases])
    return figure
