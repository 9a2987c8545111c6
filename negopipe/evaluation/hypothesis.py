"""Tests of hypotheses about planners: the evidence, findings with their intervals, and verdicts on claims."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby, pairwise, product
from typing import Any, Literal

import numpy as np
import pandas as pd

from negopipe.evaluation.metrics import behaviour_index
from negopipe.evaluation.names import FixedHorizons, in_words
from negopipe.evaluation.statistics import Estimate, mean_difference, rate
from negopipe.evaluation.trace import ADAPTIVE, Trace

Verdict = Literal["holds", "does not hold", "undecided", "not tested"]

RANDOM_SEED = 0
"""Seed of the bootstrap, so that the same episodes give the same intervals."""

PERCENT, SECONDS, METRES, PLAIN = (100.0, " %"), (1.0, " s"), (1.0, " m"), (1.0, "")
"""Units of findings: factor from the value to the number that is shown, and name."""


@dataclass(frozen=True)
class Finding:
    """A number that bears on a claim, in the unit that `text` names.

    low, high: bounds of its 95 % interval
    verdict: result of the claim's condition on this number; None = no condition
    margin: distance of `value` from the condition's bound, positive where it is met; NaN without a condition
    """

    text: str
    value: float
    low: float
    high: float
    verdict: Verdict | None = None
    margin: float = np.nan


@dataclass(frozen=True)
class Claim:
    """One claim and its result.

    number: number in docs/reading.md, "Claims of the paper"
    words: wording of the paper
    rule: condition under which it holds
    findings: measured numbers; the claim holds if all conditions on them hold
    """

    number: int
    words: str
    rule: str
    findings: Sequence[Finding]

    @property
    def verdict(self) -> Verdict:
        found = {finding.verdict for finding in self.findings} - {None}
        for verdict in ("does not hold", "undecided", "holds"):
            if verdict in found:
                return verdict
        return "not tested"

    @property
    def decisive(self) -> Finding | None:
        """The finding shown beside the verdict: the clearest one against the claim, else the closest one."""
        judged = [finding for finding in self.findings if finding.verdict == self.verdict]
        return min(judged, key=lambda finding: finding.margin, default=None)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, which has no NaN."""
        plain = {**asdict(self), "verdict": self.verdict, "decisive": self.decisive and self.decisive.text}
        for finding in plain["findings"]:
            finding |= {name: None for name, value in finding.items() if value != value}
        return plain


Want = Callable[..., Finding]
"""Condition of a claim on a number: `at_least` or `at_most`."""


class Evidence:
    """The episodes that the paper's claims are about, and comparisons between them.

    An infinite horizon is no horizon of the paper: it has a rule of its own, so it is no evidence.
    """

    def __init__(self, table: pd.DataFrame, traces: Sequence[Trace], fixed_s: FixedHorizons) -> None:
        self.rng = np.random.default_rng(RANDOM_SEED)
        of_the_paper = {name: horizon_s for name, horizon_s in fixed_s.items() if horizon_s < math.inf}
        self.fixed_s = {name: of_the_paper[name] for name in table["planner"].unique() if name in of_the_paper}
        self.fixed = sorted(self.fixed_s, key=self.fixed_s.__getitem__)
        self.psi = {trace.setting: behaviour_index(trace) for trace in traces if trace.planner == ADAPTIVE}
        compared = table[table["planner"].isin([ADAPTIVE, *self.fixed])]
        by_task = compared.groupby(["setting", "episode"])["planner"]
        is_driven_by_all = by_task.transform("nunique") == 1 + len(
            self.fixed
        )  # some planners drive the first tasks only
        self._table = compared[is_driven_by_all].assign(is_first=compared["passes_first"] == "ego")

    def has(self, *settings: str) -> bool:
        """The policy and at least one fixed horizon drove the same tasks in all these settings."""
        driven = set(self._table["setting"])
        return bool(self.fixed) and all(setting in self.psi and setting in driven for setting in settings)

    def label(self, planner: str) -> str:
        return in_words(planner, self.fixed_s)

    def measured(self, measure: str, *settings: str) -> pd.DataFrame:
        """A row per task of the settings, a column per planner; NaN where a planner has no value."""
        rows = self._table[self._table["setting"].isin(settings)]
        return rows.pivot_table(measure, ["setting", "episode"], "planner", dropna=False)

    def succeeds(self, setting: str) -> dict[str, Estimate]:
        """Success rate of each planner."""
        rows = self._table[self._table["setting"] == setting]
        return {
            p: rate((rows.loc[rows["planner"] == p, "outcome"] == "success").to_numpy())
            for p in rows["planner"].unique()
        }

    def ahead(self, measure: str, setting: str) -> dict[str, Estimate]:
        """The policy's measure minus each fixed horizon's, on the tasks in which both have a value."""
        values = self.measured(measure, setting)
        return {
            planner: mean_difference(both[ADAPTIVE].to_numpy(), both[planner].to_numpy(), self.rng)
            for planner in self.fixed
            if len(both := values[[ADAPTIVE, planner]].dropna())
        }

    def each(
        self, want: Want, text: str, estimates: Mapping[str, Estimate], unit: tuple[float, str], **wanted: Any
    ) -> list[Finding]:
        """The same condition on several planners; `text` has {} for their names."""
        return [want(text.format(self.label(planner)), e, unit, **wanted) for planner, e in estimates.items()]

    def shorter_and_longer(self) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
        """Pairs of fixed horizons: the shortest with the longest, and each with the next longer one. Empty if all are
        equal."""
        levels = [list(names) for _, names in groupby(self.fixed, self.fixed_s.__getitem__)]
        steps = [pair for level, longer in pairwise(levels) for pair in product(level, longer)]
        ends = list(product(levels[0], levels[-1])) if len(levels) > 1 else []
        return ends, steps


def at_least(text: str, e: Estimate, unit: tuple[float, str], than: float = 0.0, strictly: bool = False) -> Finding:
    """A number with the condition of being at least `than`, or strictly more.

    The condition holds if the whole interval meets it and does not hold if the whole interval fails it.
    """
    is_shown = e.low > than if strictly else e.low >= than
    is_refuted = e.high <= than if strictly else e.high < than
    return _judged(finding(text, e, unit), is_shown, is_refuted, unit[0] * (e.value - than))


def at_most(text: str, e: Estimate, unit: tuple[float, str], than: float = 0.0, strictly: bool = False) -> Finding:
    """A number with the condition of being at most `than`, or strictly less."""
    is_shown = e.high < than if strictly else e.high <= than
    is_refuted = e.low >= than if strictly else e.low > than
    return _judged(finding(text, e, unit), is_shown, is_refuted, unit[0] * (than - e.value))


def _judged(finding: Finding, is_shown: bool, is_refuted: bool, margin: float) -> Finding:
    verdict: Verdict = "holds" if is_shown else "does not hold" if is_refuted else "undecided"
    return replace(finding, verdict=verdict, margin=margin)


def finding(text: str, e: Estimate, unit: tuple[float, str]) -> Finding:
    """A number without a condition."""
    scale, name = unit
    return Finding(text + (f" [{name.strip()}]" if name else ""), scale * e.value, scale * e.low, scale * e.high)


def first_index(is_so: np.ndarray) -> np.ndarray:
    """[T, E] -> [E], the first true index, or the last index where none is true."""
    return np.where(is_so.any(0), is_so.argmax(0), len(is_so) - 1)
