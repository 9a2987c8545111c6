"""Type of a measure: one number of one planner in one setting, an aggregate of a column of episodes.csv."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import pandas as pd

from negopipe.evaluation.statistics import Estimate, rate

Aggregate = Callable[[pd.Series], Estimate | float | None]
"""Column of the episodes of one planner in one setting -> the measure; None where no episode has a value. An estimate
adds the bounds of its interval to metrics.json."""


def mean(column: pd.Series) -> float | None:
    """Mean over the episodes that have a value."""
    known = column.dropna()
    return float(known.mean()) if len(known) else None


def known(column: pd.Series) -> float:
    """Share of the episodes that have a value."""
    return float(column.notna().mean())


def share_above(bound: float) -> Aggregate:
    """Share of the episodes with a larger value; those without a value count as lower."""
    return lambda column: float((column > bound).mean())


def share(*values: str) -> Aggregate:
    """Share of the episodes with one of these values."""
    return lambda column: sum((float((column == value).mean()) for value in values), 0.0)


def share_with_interval(value: str) -> Aggregate:
    """Share of the episodes with this value and its Wilson interval."""
    return lambda column: rate((column == value).to_numpy())


def indicator(value: str) -> Callable[[pd.Series], pd.Series]:
    """1 for an episode with this value, else 0."""
    return lambda column: (column == value).astype(float)


def itself(column: pd.Series) -> pd.Series:
    """The column as it is."""
    return column


@dataclass(frozen=True)
class Measure:
    """One number of one planner in one setting.

    name: key in metrics.json, `evaluation.<setting>.<planner>.<name>`
    label: name in tables and charts
    unit: of the value as it is shown; % shows a share of 1 as 100
    meaning: definition in one sentence
    column: of episodes.csv
    aggregate: column -> measure
    decimals: digits after the point as it is shown
    better: which end is good; None where neither is, or where a planner that crashes early would look good
    table: table of the report in which it is a column; None = in none
    is_charted: it has a chart in MLflow and a column in the table on the terminal
    is_rare: the report leaves it out where it is 0 for all planners
    compared: column -> a number per episode, whose mean difference to the policy's on the same tasks is given in
        `versus_adaptive`; None = not compared
    """

    name: str
    label: str
    unit: str
    meaning: str
    column: str
    aggregate: Aggregate = mean
    decimals: int = 1
    better: Literal["higher", "lower"] | None = None
    table: Literal["outcomes", "driving", "safety"] | None = None
    is_charted: bool = False
    is_rare: bool = False
    compared: Callable[[pd.Series], pd.Series] | None = None

    @property
    def stem(self) -> str:
        """Its name in `versus_adaptive` and in the bounds of its interval: `success` of `success_rate`."""
        return self.name.removesuffix("_rate")

    @property
    def bounds(self) -> tuple[str, str]:
        """Keys of the bounds of its interval, if it has one."""
        return f"{self.stem}_low", f"{self.stem}_high"

    @property
    def heading(self) -> str:
        """`success [%]`, or the label alone where there is no unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    @property
    def factor(self) -> float:
        """Factor from the value to the number that is shown."""
        return 100.0 if self.unit == "%" else 1.0

    def text(self, value: float | None) -> str:
        """The value with its unit, `93.4 %`; `-` where there is none."""
        return "-" if value is None else f"{self.factor * value:.{self.decimals}f} {self.unit}".rstrip()
