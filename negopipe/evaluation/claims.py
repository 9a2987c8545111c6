"""The paper's claims, put to the test on evaluated episodes (docs/reading.md, "Claims of the paper").

What the paper compares is the policy and the fixed horizons, so the other planners do not count here; which planners
are fixed horizons is known from their configs. `push` and `yield` are the paper's two settings, by their names in
`conf`. A claim about which planner is best holds if none of the others is better: for each of them the interval of
the difference on the same tasks excludes that. Where an interval leaves it open, the claim is undecided. Where a
setting was not driven or there is nothing to compare, it is not tested.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby, pairwise, product
from typing import Any, Literal

import numpy as np
import pandas as pd

from negopipe.evaluation.metrics import behaviour_index
from negopipe.evaluation.names import FixedHorizons, in_words
from negopipe.evaluation.statistics import (
    Estimate,
    difference_of_means,
    mean_difference,
    probability_of_improvement,
    rate,
    spread_difference,
)
from negopipe.evaluation.trace import ADAPTIVE, Trace

Verdict = Literal["holds", "does not hold", "undecided", "not tested"]

COMPLETES = 0.95
"""A planner completes a setting if so large a share of the episodes is a success, and fails it up to 1 less this."""
CLEAR_RAD = np.radians(5.0)
"""From here on psi counts as positive or negative: both vehicles start with it at zero."""
RANDOM_SEED = 0
"""Of the bootstrap: the same episodes give the same intervals."""

PERCENT = (100.0, " %")
SECONDS = (1.0, " s")
PLAIN = (1.0, "")
METRES = (1.0, " m")


@dataclass(frozen=True)
class Finding:
    """A figure that bears on a claim, in the unit that `text` names.

    low, high: bounds of its 95 % interval
    verdict: of what the claim wants of this figure; None = it wants nothing of it
    margin: how far `value` is on the wanted side, in its unit; NaN where nothing is wanted
    """

    text: str
    value: float
    low: float
    high: float
    verdict: Verdict | None = None
    margin: float = np.nan


@dataclass(frozen=True)
class Claim:
    """One claim and what became of it.

    number: as in docs/reading.md, "Claims of the paper"
    words: the paper's
    rule: when it holds
    findings: what was measured; the claim holds if all hold of which it wants something
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
        """The figure to be shown beside the verdict: the clearest of those against the claim, else the closest."""
        judged = [finding for finding in self.findings if finding.verdict == self.verdict]
        return min(judged, key=lambda finding: finding.margin, default=None)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON, which knows no NaN."""
        plain = {**asdict(self), "verdict": self.verdict, "decisive": self.decisive and self.decisive.text}
        for finding in plain["findings"]:
            finding |= {name: None for name, value in finding.items() if value != value}
        return plain


Want = Callable[..., Finding]
"""What a claim wants of a figure: `_more` or `_less`."""


class _Evidence:
    """The episodes that the paper's claims are about, and comparisons of them."""

    def __init__(self, table: pd.DataFrame, traces: Sequence[Trace], fixed_s: FixedHorizons) -> None:
        self.rng = np.random.default_rng(RANDOM_SEED)
        self.fixed_s = {name: fixed_s[name] for name in table["planner"].unique() if name in fixed_s}
        self.fixed = sorted(self.fixed_s, key=self.fixed_s.__getitem__)
        self.psi = {trace.family: behaviour_index(trace) for trace in traces if trace.planner == ADAPTIVE}
        compared = table[table["planner"].isin([ADAPTIVE, *self.fixed])]
        by_task = compared.groupby(["setting", "episode"])["planner"]
        is_driven_by_all = by_task.transform("nunique") == 1 + len(self.fixed)  # some may have driven the first only
        self._table = compared[is_driven_by_all].assign(is_first=compared["passes_first"] == "ego")

    def has(self, *settings: str) -> bool:
        """The policy and at least one fixed horizon drove the same tasks in all these settings."""
        driven = set(self._table["setting"])
        return bool(self.fixed) and all(setting in self.psi and setting in driven for setting in settings)

    def label(self, planner: str) -> str:
        return in_words(planner, self.fixed_s)

    def measured(self, measure: str, *settings: str) -> pd.DataFrame:
        """A row per task of the settings, a column per planner; NaN where a planner has no such figure."""
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
        """The policy's measure less each fixed horizon's, on the tasks where both have one."""
        values = self.measured(measure, setting)
        return {
            planner: mean_difference(both[ADAPTIVE].to_numpy(), both[planner].to_numpy(), self.rng)
            for planner in self.fixed
            if len(both := values[[ADAPTIVE, planner]].dropna())
        }

    def each(
        self, want: Want, text: str, estimates: Mapping[str, Estimate], unit: tuple[float, str], **wanted: Any
    ) -> list[Finding]:
        """The same figure of several planners; `text` has {} for their names."""
        return [want(text.format(self.label(planner)), e, unit, **wanted) for planner, e in estimates.items()]

    def shorter_and_longer(self) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
        """Pairs of fixed horizons: the shortest with the longest, and each with the next longer one. Empty where all
        are equal."""
        levels = [list(names) for _, names in groupby(self.fixed, self.fixed_s.__getitem__)]
        steps = [pair for level, longer in pairwise(levels) for pair in product(level, longer)]
        ends = list(product(levels[0], levels[-1])) if len(levels) > 1 else []
        return ends, steps


def judge_claims(table: pd.DataFrame, traces: Sequence[Trace], fixed_s: FixedHorizons) -> list[Claim]:
    """All ten claims.

    table: rows of `metrics.episodes` with the columns of `safety`, of all planners and settings
    traces: of the policy, for the behaviour index
    fixed_s: which of the planners are fixed horizons
    """
    evidence = _Evidence(table, traces, fixed_s)
    return [_test(evidence, number, *claim) for number, claim in enumerate(_CLAIMS, start=1)]


def judge_curriculum(rewards: np.ndarray, rewards_without: np.ndarray) -> Claim:
    """The last of the claims, by the rewards of trainings with several stages and of others with the last stage alone.

    rewards, rewards_without: [S], [S'] mean reward over the settings of each training; as many decisions in all
    """
    words, rule, *_ = _CLAIMS[-1]
    better = probability_of_improvement(rewards, rewards_without, np.random.default_rng(RANDOM_SEED))
    more = difference_of_means(rewards, rewards_without, np.random.default_rng(RANDOM_SEED))
    findings = [
        _more("a training with it has the higher reward", better, PERCENT, than=0.5, strictly=True),
        _finding("reward with it less that without", more, PLAIN),
    ]
    return Claim(len(_CLAIMS), words, rule, findings)


def _test(
    evidence: _Evidence,
    number: int,
    words: str,
    rule: str,
    settings: Sequence[str],
    test: Callable[[_Evidence], list[Finding]] | None,
) -> Claim:
    findings = test(evidence) if test is not None and evidence.has(*settings) else []
    return Claim(number, words, rule, findings)


def _push_is_completed(evidence: _Evidence) -> list[Finding]:
    share, slower = evidence.succeeds("push"), evidence.ahead("driving_time_s", "push")
    completed = evidence.each(_more, "success of {}", share, PERCENT, than=COMPLETES)
    return completed + evidence.each(_less, "time less that of {}", slower, SECONDS)


def _push_suspends_least(evidence: _Evidence) -> list[Finding]:
    return evidence.each(_less, "suspensions less those of {}", evidence.ahead("suspend_count", "push"), PLAIN)


def _rewarded_most(setting: str) -> Callable[[_Evidence], list[Finding]]:
    def test(evidence: _Evidence) -> list[Finding]:
        return evidence.each(_more, "reward less that of {}", evidence.ahead("reward", setting), PLAIN)

    return test


def _only_the_policy_yields(evidence: _Evidence) -> list[Finding]:
    share = evidence.succeeds("yield")
    own, others = {ADAPTIVE: share[ADAPTIVE]}, {planner: share[planner] for planner in evidence.fixed}
    arrives = evidence.each(_more, "success of {}", own, PERCENT, than=COMPLETES)
    return arrives + evidence.each(_less, "success of {}", others, PERCENT, than=1 - COMPLETES, strictly=True)


def _yield_suspends_between(evidence: _Evidence) -> list[Finding]:
    in_yield, in_push = (evidence.measured("suspend_count", s)[ADAPTIVE].to_numpy() for s in ("yield", "push"))
    more = difference_of_means(in_yield, in_push, evidence.rng)
    less = evidence.ahead("suspend_count", "yield")
    findings = [_more("suspensions in yield less those in push", more, PLAIN, strictly=True)]
    return findings + evidence.each(_less, "in yield, suspensions less those of {}", less, PLAIN)


def _behaviour_fits(evidence: _Evidence) -> list[Finding]:
    push, yield_ = evidence.psi["push"], evidence.psi["yield"]
    stays_negative = rate(~(push > CLEAR_RAD).any(0))
    first = _first(np.abs(yield_) > CLEAR_RAD)
    is_positive_first = np.take_along_axis(yield_, first[None], 0)[0] > CLEAR_RAD
    is_after = np.arange(len(yield_))[:, None] > first
    turns = rate(is_positive_first & ((yield_ < -CLEAR_RAD) & is_after).any(0))
    return [
        _more("push: episodes in which psi stays negative", stays_negative, PERCENT, than=0.5),
        _finding("yield: episodes in which psi is positive first", rate(is_positive_first), PERCENT),
        _more("yield: episodes in which it is positive first and negative later", turns, PERCENT, than=0.5),
    ]


def _shorter_is_bolder(evidence: _Evidence) -> list[Finding]:
    first = evidence.measured("is_first", "push", "yield")
    gap = evidence.measured("smallest_gap_m", "push", "yield")
    ends, steps = evidence.shorter_and_longer()
    more, closer = [], []
    for shorter, longer in dict.fromkeys([*steps, *ends]):
        pair = f"{evidence.label(shorter)} against {evidence.label(longer)}"
        strictly = (shorter, longer) in ends
        often = mean_difference(first[shorter].to_numpy(), first[longer].to_numpy(), evidence.rng)
        more.append(_more(f"passes first more often, {pair}", often, PERCENT, strictly=strictly))
        kept = gap[[shorter, longer]].dropna()
        nearer = mean_difference(kept[longer].to_numpy(), kept[shorter].to_numpy(), evidence.rng)
        closer.append(_more(f"comes closer, {pair}", nearer, METRES, strictly=strictly))
    return more + closer


def _spreads_least(evidence: _Evidence) -> list[Finding]:
    reward = evidence.measured("reward", "push", "yield")
    wider = {
        planner: spread_difference(reward[planner].to_numpy(), reward[ADAPTIVE].to_numpy(), evidence.rng)
        for planner in evidence.fixed
    }
    return evidence.each(_more, "spread (std) of the reward of {}, less the policy's", wider, PLAIN)


def _more(text: str, e: Estimate, unit: tuple[float, str], than: float = 0.0, strictly: bool = False) -> Finding:
    """A figure of which the claim wants that it is at least `than`, or more than that.

    It holds if the whole interval is on that side and does not if the whole interval is on the other.
    """
    is_shown = e.low > than if strictly else e.low >= than
    is_refuted = e.high <= than if strictly else e.high < than
    return _judged(_finding(text, e, unit), is_shown, is_refuted, unit[0] * (e.value - than))


def _less(text: str, e: Estimate, unit: tuple[float, str], than: float = 0.0, strictly: bool = False) -> Finding:
    """The same of `than` at most, or less than that."""
    is_shown = e.high < than if strictly else e.high <= than
    is_refuted = e.low >= than if strictly else e.low > than
    return _judged(_finding(text, e, unit), is_shown, is_refuted, unit[0] * (than - e.value))


def _judged(finding: Finding, is_shown: bool, is_refuted: bool, margin: float) -> Finding:
    verdict: Verdict = "holds" if is_shown else "does not hold" if is_refuted else "undecided"
    return replace(finding, verdict=verdict, margin=margin)


def _finding(text: str, e: Estimate, unit: tuple[float, str]) -> Finding:
    """A figure of which nothing is wanted."""
    scale, name = unit
    return Finding(text + (f" [{name.strip()}]" if name else ""), scale * e.value, scale * e.low, scale * e.high)


def _first(is_so: np.ndarray) -> np.ndarray:
    """[T, E] -> [E], the first index that is true, the last one where none is."""
    return np.where(is_so.any(0), is_so.argmax(0), len(is_so) - 1)


_NONE_BETTER = "for no fixed horizon does the 95 % interval of the difference on the same tasks show it to be better"
_CLAIMS: Sequence[tuple[str, str, Sequence[str], Callable[[_Evidence], list[Finding]] | None]] = (
    (
        'Push: "all the algorithm could complete driving task in limit time, while the adaptive behavior planner has '
        'better driving efficiency"',
        f"every planner succeeds in at least {COMPLETES:.0%} of the episodes, and where both arrive {_NONE_BETTER}",
        ["push"],
        _push_is_completed,
    ),
    ('Push: the adaptive planner takes "less suspend time"', _NONE_BETTER, ["push"], _push_suspends_least),
    ('Push: "tends to have a higher reward"', _NONE_BETTER, ["push"], _rewarded_most("push")),
    (
        'Yield: "except the proposed algorithm, other schemes could not reach the goal position in limit time"',
        f"the policy succeeds in at least {COMPLETES:.0%}, every fixed horizon in less than {1 - COMPLETES:.0%}",
        ["yield"],
        _only_the_policy_yields,
    ),
    (
        'Yield: "the suspend time tends to be more than that in push experiment setting"; less than the fixed ones do',
        f"the policy suspends more often than in push, and in yield {_NONE_BETTER}",
        ["push", "yield"],
        _yield_suspends_between,
    ),
    (
        'Yield: "our framework has a higher reward than the polynomial planner with fixed prediction horizon"',
        _NONE_BETTER,
        ["yield"],
        _rewarded_most("yield"),
    ),
    (
        "Push: the behaviour index stays negative. Yield: it is positive first, negative later",
        "so it is in most episodes (beyond 5 degrees)",
        ["push", "yield"],
        _behaviour_fits,
    ),
    (
        "A shorter prediction horizon gives more aggressive driving",
        "push and yield together: the shortest fixed horizon passes first more often and comes closer than the "
        "longest, and none passes first less often or stays farther off than the next longer one",
        ["push", "yield"],
        _shorter_is_bolder,
    ),
    (
        '"The performance of our proposed framework has better stability"',
        "push and yield together: no fixed horizon's reward spreads less",
        ["push", "yield"],
        _spreads_least,
    ),
    (
        'The curriculum helps "to enhance the training efficiency and robustness"',
        "after as many decisions, a training with it has more likely than not the higher reward, mean over the "
        "settings; judged by the report over such runs (jobs/ablation_curriculum.sh)",
        [],
        None,
    ),
)
