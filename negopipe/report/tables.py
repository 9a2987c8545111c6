"""The page's tables of numbers: a row per planner, a column per measure, so that many planners fit a phone's width."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from negopipe.evaluation import measures
from negopipe.evaluation.measure import Measure
from negopipe.evaluation.names import FixedHorizons
from negopipe.report.headlines import Difference, Measures, Versus
from negopipe.report.labels import planner_label
from negopipe.report.style import planner_colors


@dataclass(frozen=True)
class Cell:
    """A number as it is printed, its interval under it (may be empty), whether it is the best of its column."""

    text: str
    interval: str = ""
    is_best: bool = False


@dataclass(frozen=True)
class Row:
    """Label of the row, its colour in the figures as hex, a cell per column."""

    label: str
    color: str
    cells: Sequence[Cell]


@dataclass(frozen=True)
class Table:
    """Caption, labels of the columns, rows."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Row]


@dataclass(frozen=True)
class Column:
    """One column of a table.

    label: with the unit
    key: of the number; `a.b` is the entry b of the entry a
    factor, decimals: how the number is printed
    best: which end is good
    bounds: keys of its interval, if it has one
    is_signed: it is a difference, printed with its sign
    """

    label: str
    key: str
    factor: float = 1.0
    decimals: int = 1
    best: Literal["max", "min"] | None = None
    bounds: tuple[str, str] | None = None
    is_signed: bool = False


CAPTIONS = {
    "outcomes": "Outcomes (timeouts include deadlocks)",
    "driving": "Driving",
    "safety": "Safety: means of smallest gap and TTC, largest deceleration and jerk",
}
"""Name of a table of measures -> its caption, in the order of the page."""
BEST: dict[str | None, Literal["max", "min"] | None] = {"higher": "max", "lower": "min", None: None}
REGRET = (Column("regret", "value", 1, 2, "min", ("low", "high")), Column("tasks", "n_tasks", 1, 0))


def column_of(measure: Measure, has_interval: bool) -> Column:
    """The column of a measure in a table of measures."""
    bounds = measure.bounds if has_interval else None
    return Column(measure.heading, measure.name, measure.factor, measure.decimals, BEST[measure.better], bounds)


def difference_of(measure: Measure) -> Column:
    """The column of a measure in the table of paired differences; a difference of percentages is in points."""
    unit = "points" if measure.unit == "%" else measure.unit
    key, bounds = f"{measure.stem}.value", (f"{measure.stem}.low", f"{measure.stem}.high")
    label = replace(measure, unit=unit).heading
    return Column(label, key, measure.factor, measure.decimals, None, bounds, is_signed=True)


def tables(
    values: Mapping[str, Measures],
    versus: Mapping[str, Versus],
    regret: Mapping[str, Difference],
    fixed_s: FixedHorizons,
) -> list[Table]:
    """Tables of one setting.

    values: planner -> measures; versus: planner other than the policy -> differences to it
    regret: planner -> difference of the oracle to it
    """
    label = {planner: planner_label(planner, fixed_s) for planner in values}
    colors = planner_colors(list(values), fixed_s)
    drawn = [table(CAPTIONS[name], _columns(name, values), values, label, colors) for name in CAPTIONS]
    if versus:
        caption = "Differences from the adaptive planner on the same tasks (driving time: where both arrive)"
        columns = [difference_of(measure) for measure in measures.MEASURES if measure.compared is not None]
        drawn.append(table(caption, columns, versus, label, colors))
    if regret:
        drawn.append(table("Regret to the oracle on its tasks", REGRET, regret, label, colors))
    return drawn


def _columns(name: str, values: Mapping[str, Measures]) -> list[Column]:
    """Columns of the table of that name, without rare measures that are 0 for all planners."""
    own = [measure for measure in measures.MEASURES if measure.table == name]
    shown = [m for m in own if not m.is_rare or any(each.get(m.name) for each in values.values())]
    return [column_of(m, has_interval=any(m.bounds[0] in each for each in values.values())) for m in shown]


def n_episodes(values: Mapping[str, Measures], fixed_s: FixedHorizons) -> str:
    """`500 episodes each`, with the planners that drove only the first of them."""
    most = max(each["n_episodes"] for each in values.values())
    fewer = [
        f"{planner_label(planner, fixed_s)} {each['n_episodes']}"
        for planner, each in values.items()
        if each["n_episodes"] < most
    ]
    return f"{most} episodes each" + (f" ({', '.join(fewer)}, the first ones)" if fewer else "")


def table(
    caption: str,
    columns: Sequence[Column],
    values: Mapping[str, Mapping[str, Any]],
    labels: Mapping[str, str],
    colors: Mapping[str, str],
) -> Table:
    """A row per key of `values`, whose entries hold the numbers of the columns; labels and colors have these keys."""
    by_column = [_cells(column, list(values.values())) for column in columns]
    rows = [Row(labels[key], colors[key], [cells[i] for cells in by_column]) for i, key in enumerate(values)]
    return Table(caption, [column.label for column in columns], rows)


def _cells(column: Column, rows: Sequence[Mapping[str, Any]]) -> list[Cell]:
    values = [_value(row, column.key) for row in rows]
    return [
        Cell(_number(column, value), _interval(column, row), is_best)
        for row, value, is_best in zip(rows, values, _best(column, values), strict=True)
    ]


def _value(values: Mapping[str, Any], key: str) -> float | None:
    """The number under a key."""
    found: Any = values
    for part in key.split("."):
        found = found[part]
    return found


def _number(column: Column, value: float | None) -> str:
    if value is None:
        return "none"
    rounded = round(column.factor * value, column.decimals) + 0.0  # no negative zero
    text = f"{rounded:{'+' if column.is_signed and rounded else ''}.{column.decimals}f}"
    return text.replace("-", "\N{MINUS SIGN}")


def _interval(column: Column, values: Mapping[str, Any]) -> str:
    """`low to high`, or nothing where there is no interval."""
    bounds = [_value(values, key) for key in column.bounds or ()]
    if not bounds or None in bounds:
        return ""
    return " to ".join(_number(column, bound) for bound in bounds)


def _best(column: Column, values: Sequence[float | None]) -> list[bool]:
    """Values that are the best of their column as printed; none if all are the same."""
    texts = [_number(column, value) for value in values]
    known = [value for value in values if value is not None]
    if column.best is None or not known or len(set(texts)) == 1:
        return [False] * len(values)
    best = _number(column, max(known) if column.best == "max" else min(known))
    return [text == best for text in texts]
