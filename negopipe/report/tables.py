"""The page's tables of numbers: a row per planner, so that any number of planners fits a phone's width."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

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
    """What the row is about, its colour in the figures as hex, a cell per column."""

    label: str
    color: str
    cells: Sequence[Cell]


@dataclass(frozen=True)
class Table:
    caption: str
    columns: Sequence[str]
    rows: Sequence[Row]


@dataclass(frozen=True)
class Column:
    """label: with the unit; key: of the measure; bounds: keys of its interval; factor, decimals: how it is printed;
    best: which end is good; is_signed: a difference, printed with its sign."""

    label: str
    key: str
    factor: float = 1.0
    decimals: int = 1
    best: Literal["max", "min"] | None = None
    bounds: tuple[str, str] | None = None
    is_signed: bool = False


ENDED = (
    Column("success [%]", "success_rate", 100, 1, "max", ("success_low", "success_high")),
    Column("collision [%]", "collision_rate", 100, 1, "min", ("collision_low", "collision_high")),
    Column("timeout [%]", "timeout_rate", 100),
    Column("of these dead-lock [%]", "deadlock_rate", 100),
    Column("reward (Eq. 3)", "reward", 1, 2, "max"),
)
AMONG_OTHERS = Column("crash among others [%]", "social_collision_rate", 100)
"""... where there was one."""
DROVE = (
    Column("time of arrivals [s]", "driving_time_s"),
    Column("the other's time [s]", "social_time_s"),
    Column("time at rest [s]", "suspend_time_s"),
    Column("suspen-sions", "suspend_count", 1, 2),
    Column("passes first [%]", "ego_first_rate", 100),
)
CAME_CLOSE = (
    Column("gap [m]", "smallest_gap_m", 1, 2),
    Column("TTC [s]", "smallest_ttc_s"),
    Column("braking [m/s²]", "largest_decel_mps2"),
    Column("jerk [m/s³]", "largest_jerk_mps3"),
    Column("with-out a plan [count]", "full_braking_count"),
    Column("avoid-able crashes [%]", "avoidable_rate", 100),
)
COMPARED = tuple(
    Column(label, f"{measure}.value", factor, decimals, None, (f"{measure}.low", f"{measure}.high"), is_signed=True)
    for label, measure, factor, decimals in (
        ("success [points]", "success", 100, 1),
        ("time where both arrive [s]", "driving_time_s", 1, 2),
        ("reward", "reward", 1, 2),
    )
)
LACKED = (Column("regret", "value", 1, 2, "min", ("low", "high")), Column("tasks", "n_tasks", 1, 0))


def tables(
    measures: Mapping[str, Measures],
    versus: Mapping[str, Versus],
    regret: Mapping[str, Difference],
    fixed_s: FixedHorizons,
) -> list[Table]:
    """Of one setting.

    measures: planner -> measures; versus: planner other than the policy -> differences to it
    regret: planner -> difference of the oracle to it
    """
    has_crashed = any(each.get("social_collision_rate") for each in measures.values())
    tables_of_all = {
        "How the episodes ended": (*ENDED, AMONG_OTHERS) if has_crashed else ENDED,
        "How the ego drove": DROVE,
        "Closest and hardest of each episode, and decisions without a feasible plan (full braking): means": CAME_CLOSE,
    }
    label = {planner: planner_label(planner, fixed_s) for planner in measures}
    colors = planner_colors(list(measures), fixed_s)
    drawn = [table(caption, columns, measures, label, colors) for caption, columns in tables_of_all.items()]
    if versus:
        drawn.append(table("Difference from the adaptive planner, on the same tasks", COMPARED, versus, label, colors))
    if regret:
        drawn.append(table("What the reward lacks to the oracle's, on its tasks", LACKED, regret, label, colors))
    return drawn


def n_episodes(measures: Mapping[str, Measures], fixed_s: FixedHorizons) -> str:
    """`500 episodes each`, with the planners that drove fewer of them."""
    most = max(each["n_episodes"] for each in measures.values())
    fewer = [
        f"{planner_label(planner, fixed_s)} {each['n_episodes']}"
        for planner, each in measures.items()
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
    """A row per key of `values`, which holds what the columns name; labels and colors are of the same keys."""
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
    """Which values are the best of their column as printed; none if all are the same."""
    texts = [_number(column, value) for value in values]
    known = [value for value in values if value is not None]
    if column.best is None or not known or len(set(texts)) == 1:
        return [False] * len(values)
    best = _number(column, max(known) if column.best == "max" else min(known))
    return [text == best for text in texts]
