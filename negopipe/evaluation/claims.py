"""The paper's claims, put to the test on evaluated episodes (docs/reading.md, "Claims of the paper").

What the paper compares is the policy and the fixed horizons, so the other planners do not count here; which planners
are fixed horizons is known from their configs. `push` and `yield` are the paper's two settings, by their names in
`conf`. A claim about which planner is best holds if none of the others is better: for each of them the interval of
the difference on the same tasks excludes that. Where an interval leaves it open, the claim is undecided. Where a
setting was not driven or there is nothing to compare, it is not tested.
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
"""A planner completes a setting if so large a share of the episodes is a success, and fails it up to 1 less this."""
CLEAR_RAD = np.radians(5.0)
"""From here on psi counts as positive or negative: both vehicles start with it at zero."""


def judge_claims(table: pd.DataFrame, traces: Sequence[Trace], fixed_s: FixedHorizons) -> list[Claim]:
    """All ten claims.

    table: rows of `metrics.episodes` with the columns of `safety`, of all planners and settings
    traces: of the policy, for the behaviour index
    fixed_s: which of the planners are fixed horizons
    """
    evidence = Evidence(table, traces, fixed_s)
    return [_test(evidence, number, *claim) for number, claim in enumerate(_CLAIMS, start=1)]


def judge_curriculum(rewards: np.ndarray, rewards_without: np.ndarray) -> Claim:
    """The last of the claims, by the rewards of trainings with several stages and of others with the last stage alone.

    rewards, rewards_without: [S], [S'] mean reward over the settings of each training; as many decisions in all
    """
    words, rule, *_ = _CLAIMS[-1]
    better = probability_of_improvement(rewards, rewards_without, np.random.default_rng(RANDOM_SEED))
    more = difference_of_means(rewards, rewards_without, np.random.default_rng(RANDOM_SEED))
    findings = [
        at_least("a training with it has the higher reward", better, PERCENT, than=0.5, strictly=True),
        finding("reward with it less that without", more, PLAIN),
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
    completed = evidence.each(at_least, "success of {}", share, PERCENT, than=COMPLETES)
    return completed + evidence.each(at_most, "time less that of {}", slower, SECONDS)


def _push_suspends_least(evidence: Evidence) -> list[Finding]:
    return evidence.each(at_most, "suspensions less those of {}", evidence.ahead("suspend_count", "push"), PLAIN)


def _rewarded_most(setting: str) -> Callable[[Evidence], list[Finding]]:
    def test(evidence: Evidence) -> list[Finding]:
        return evidence.each(at_least, "reward less that of {}", evidence.ahead("reward", setting), PLAIN)

    return test


def _only_the_policy_yields(evidence: Evidence) -> list[Finding]:
    share = evidence.succeeds("yield")
    own, others = {ADAPTIVE: share[ADAPTIVE]}, {planner: share[planner] for planner in evidence.fixed}
    arrives = evidence.each(at_least, "success of {}", own, PERCENT, than=COMPLETES)
    return arrives + evidence.each(at_most, "success of {}", others, PERCENT, than=1 - COMPLETES, strictly=True)


def _yield_suspends_between(evidence: Evidence) -> list[Finding]:
    in_yield, in_push = (evidence.measured("suspend_count", s)[ADAPTIVE].to_numpy() for s in ("yield", "push"))
    more = difference_of_means(in_yield, in_push, evidence.rng)
    less = evidence.ahead("suspend_count", "yield")
    findings = [at_least("suspensions in yield less those in push", more, PLAIN, strictly=True)]
    return findings + evidence.each(at_most, "in yield, suspensions less those of {}", less, PLAIN)


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
        at_least("yield: episodes in which it is positive first and negative later", turns, PERCENT, than=0.5),
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
        more.append(at_least(f"passes first more often, {pair}", often, PERCENT, strictly=strictly))
        kept = gap[[shorter, longer]].dropna()
        nearer = mean_difference(kept[longer].to_numpy(), kept[shorter].to_numpy(), evidence.rng)
        closer.append(at_least(f"comes closer, {pair}", nearer, METRES, strictly=strictly))
    return more + closer


def _spreads_least(evidence: Evidence) -> list[Finding]:
    reward = evidence.measured("reward", "push", "yield")
    wider = {
        planner: spread_difference(reward[planner].to_numpy(), reward[ADAPTIVE].to_numpy(), evidence.rng)
        for planner in evidence.fixed
    }
    return evidence.each(at_least, "spread (std) of the reward of {}, less the policy's", wider, PLAIN)


_NONE_BETTER = "for no fixed horizon does the 95 % interval of the difference on the same tasks show it to be better"
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
        "settings; judged by negopipe.sweeping.compare over such runs (jobs/ablation_curriculum.sh)",
        [],
        None,
    ),
)
