"""Tests of the paper's claims on evaluated episodes (docs/reading.md, "Claims of the paper").

The paper compares the policy with the fixed horizons, so the other planners are left out; the planners' configs tell
which are fixed horizons. `push` and `yield` are the paper's two settings, by their names in `conf`. A claim that a
planner is best holds if no other is better: for each other, the interval of the difference on the same tasks excludes
it. A claim is undecided where an interval includes both answers. It is not tested where a setting was not driven or
there is nothing to compare.
"""

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from negopipe.evaluation.hypothesis import (
    METRES,
    PERCENT,
    PLAIN,
    RANDOM_SEED,
    SECONDS,
    Claim,
    Evidence,
    Finding,
    at_least,
    at_most,
    finding,
    first_index,
)
from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.statistics import (
    difference_of_means,
    mean_difference,
    probability_of_improvement,
    rate,
    spread_difference,
)
from negopipe.evaluation.trace import ADAPTIVE, Trace

COMPLETES = 0.95
"""Success rate from which a planner completes a setting. A planner fails a setting below 1 minus this rate."""
CLEAR_RAD = np.radians(5.0)
"""Absolute psi from which its sign counts; psi starts at zero."""


def judge_claims(table: pd.DataFrame, traces: Sequence[Trace], fixed_s: FixedHorizons) -> list[Claim]:
    """Results of all ten claims.

    table: rows of episodes.csv of all planners and settings
    traces: records of the policy, for the behaviour index
    fixed_s: planners with a fixed horizon
    """
    evidence = Evidence(table, traces, fixed_s)
    return [_test(evidence, number, *claim) for number, claim in enumerate(_CLAIMS, start=1)]


def judge_curriculum(rewards: np.ndarray, rewards_without: np.ndarray) -> Claim:
    """Result of the last claim, from the rewards of trainings with several stages and with the last stage alone.

    rewards, rewards_without: [S], [S'] mean reward over the settings of each training, all of the same decisions
    """
    words, rule, *_ = _CLAIMS[-1]
    better = probability_of_improvement(rewards, rewards_without, np.random.default_rng(RANDOM_SEED))
    more = difference_of_means(rewards, rewards_without, np.random.default_rng(RANDOM_SEED))
    findings = [
        at_least(
            "higher reward of a training with the curriculum than of one without",
            better,
            PERCENT,
            than=0.5,
            strictly=True,
        ),
        finding("reward with the curriculum minus reward without", more, PLAIN),
    ]
    return Claim(len(_CLAIMS), words, rule, findings)


def _test(
    evidence: Evidence,
    number: int,
    words: str,
    rule: str,
    settings: Sequence[str],
    test: Callable[[Evidence], list[Finding]] | None,
) -> Claim:
    findings = test(evidence) if test is not None and evidence.has(*settings) else []
    return Claim(number, words, rule, findings)


def _push_is_completed(evidence: Evidence) -> list[Finding]:
    share, slower = evidence.succeeds("push"), evidence.ahead("driving_time_s", "push")
    completed = evidence.each(at_least, "success rate of {}", share, PERCENT, than=COMPLETES)
    return completed + evidence.each(at_most, "driving time minus that of {}", slower, SECONDS)


def _push_suspends_least(evidence: Evidence) -> list[Finding]:
    return evidence.each(at_most, "suspensions minus those of {}", evidence.ahead("suspend_count", "push"), PLAIN)


def _rewarded_most(setting: str) -> Callable[[Evidence], list[Finding]]:
    def test(evidence: Evidence) -> list[Finding]:
        return evidence.each(at_least, "reward minus that of {}", evidence.ahead("reward", setting), PLAIN)

    return test


def _only_the_policy_yields(evidence: Evidence) -> list[Finding]:
    share = evidence.succeeds("yield")
    own, others = {ADAPTIVE: share[ADAPTIVE]}, {planner: share[planner] for planner in evidence.fixed}
    arrives = evidence.each(at_least, "success rate of {}", own, PERCENT, than=COMPLETES)
    return arrives + evidence.each(at_most, "success rate of {}", others, PERCENT, than=1 - COMPLETES, strictly=True)


def _yield_suspends_between(evidence: Evidence) -> list[Finding]:
    in_yield, in_push = (evidence.measured("suspend_count", s)[ADAPTIVE].to_numpy() for s in ("yield", "push"))
    more = difference_of_means(in_yield, in_push, evidence.rng)
    less = evidence.ahead("suspend_count", "yield")
    findings = [at_least("suspensions in yield minus those in push", more, PLAIN, strictly=True)]
    return findings + evidence.each(at_most, "yield: suspensions minus those of {}", less, PLAIN)


def _behaviour_fits(evidence: Evidence) -> list[Finding]:
    push, yield_ = evidence.psi["push"], evidence.psi["yield"]
    stays_negative = rate(~(push > CLEAR_RAD).any(0))
    first = first_index(np.abs(yield_) > CLEAR_RAD)
    is_positive_first = np.take_along_axis(yield_, first[None], 0)[0] > CLEAR_RAD
    is_after = np.arange(len(yield_))[:, None] > first
    turns = rate(is_positive_first & ((yield_ < -CLEAR_RAD) & is_after).any(0))
    return [
        at_least("push: episodes in which psi stays negative", stays_negative, PERCENT, than=0.5),
        finding("yield: episodes in which psi is positive first", rate(is_positive_first), PERCENT),
        at_least("yield: episodes in which psi is positive first and negative later", turns, PERCENT, than=0.5),
    ]


def _shorter_is_bolder(evidence: Evidence) -> list[Finding]:
    first = evidence.measured("is_first", "push", "yield")
    gap = evidence.measured("smallest_gap_m", "push", "yield")
    ends, steps = evidence.shorter_and_longer()
    more, closer = [], []
    for shorter, longer in dict.fromkeys([*steps, *ends]):
        pair = f"{evidence.label(shorter)} against {evidence.label(longer)}"
        strictly = (shorter, longer) in ends
        often = mean_difference(first[shorter].to_numpy(), first[longer].to_numpy(), evidence.rng)
        more.append(at_least(f"higher share of first passages, {pair}", often, PERCENT, strictly=strictly))
        kept = gap[[shorter, longer]].dropna()
        nearer = mean_difference(kept[longer].to_numpy(), kept[shorter].to_numpy(), evidence.rng)
        closer.append(at_least(f"smaller gap, {pair}", nearer, METRES, strictly=strictly))
    return more + closer


def _spreads_least(evidence: Evidence) -> list[Finding]:
    reward = evidence.measured("reward", "push", "yield")
    wider = {
        planner: spread_difference(reward[planner].to_numpy(), reward[ADAPTIVE].to_numpy(), evidence.rng)
        for planner in evidence.fixed
    }
    return evidence.each(at_least, "standard deviation of the reward of {} minus the policy's", wider, PLAIN)


_NONE_BETTER = "the 95 % interval of the difference on the same tasks shows no fixed horizon to be better"
_CLAIMS: Sequence[tuple[str, str, Sequence[str], Callable[[Evidence], list[Finding]] | None]] = (
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
        "this holds in most episodes (beyond 5 degrees)",
        ["push", "yield"],
        _behaviour_fits,
    ),
    (
        "A shorter prediction horizon gives more aggressive driving",
        "push and yield together: the shortest fixed horizon passes first more often and with a smaller gap than the "
        "longest, and no fixed horizon does so less often or with a larger gap than the next longer one",
        ["push", "yield"],
        _shorter_is_bolder,
    ),
    (
        '"The performance of our proposed framework has better stability"',
        "push and yield together: the reward of no fixed horizon has a smaller standard deviation",
        ["push", "yield"],
        _spreads_least,
    ),
    (
        'The curriculum helps "to enhance the training efficiency and robustness"',
        "after equally many decisions, a training with the curriculum has more likely than not the higher mean reward "
        "over the settings; tested by negopipe.sweeping.compare over such runs (jobs/ablation_curriculum.sh)",
        [],
        None,
    ),
)
