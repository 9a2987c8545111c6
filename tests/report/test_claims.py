"""Claims: what holds, what does not, what is left open; on made-up evaluations in which that is known."""

import json

import numpy as np
import pandas as pd
import pytest

from negopipe.evaluation.claims import Claim, judge_claims
from negopipe.evaluation.trace import Trace

N = 100
DRIVES = {
    "push": {"adaptive": (7.0, 0, 8.0), "fixed_0": (8.0, 0, 7.0), "fixed_6": (9.0, 1, 6.0)},
    "yield": {"adaptive": (14.0, 1, 5.0), "fixed_0": (None, 2, -10.0), "fixed_6": (None, 3, -32.0)},
}
"""setting -> planner -> time (None = never arrives), suspensions and reward: as the paper has it."""


def made_up(
    drives: dict = DRIVES, first: tuple = (0.9, 0.1), gap: tuple = (0.3, 0.9), spread: tuple = (0.1, 2.0)
) -> pd.DataFrame:
    """`first`, `gap`: of the shortest and the longest horizon; `spread`: of the policy's and the others' rewards."""
    rng = np.random.default_rng(1)
    rows = []
    for setting, planners in drives.items():
        for planner, (time_s, suspensions, reward) in planners.items():
            which = int(planner == "fixed_6")
            rows.append(
                pd.DataFrame(
                    {
                        "planner": planner,
                        "setting": setting,
                        "episode": range(N),
                        "outcome": "deadlock" if time_s is None else "success",
                        "driving_time_s": np.nan if time_s is None else time_s + 0.1 * rng.normal(size=N),
                        "suspend_count": suspensions,
                        "reward": reward + spread[planner != "adaptive"] * rng.normal(size=N),
                        "passes_first": np.where(rng.random(N) < first[which], "ego", "social"),
                        "smallest_gap_m": gap[which] + 0.05 * rng.normal(size=N),
                    }
                )
            )
    return pd.concat(rows, ignore_index=True)


def judged(table: pd.DataFrame, traces: list[Trace]) -> dict[int, Claim]:
    return {claim.number: claim for claim in judge_claims(table, traces)}


def test_what_the_paper_says_holds_where_it_is_so(traces: list[Trace]) -> None:
    found = judged(made_up(), traces)
    assert {number: found[number].verdict for number in (1, 2, 3, 4, 5, 6, 8, 9)} == dict.fromkeys(
        (1, 2, 3, 4, 5, 6, 8, 9), "holds"
    )
    assert found[10].verdict == "not tested"


@pytest.mark.parametrize(
    ("number", "setting", "planner", "drive"),
    [
        (1, "push", "fixed_0", (6.0, 0, 7.0)),  # faster
        (1, "push", "fixed_6", (None, 1, 6.0)),  # never arrives
        (2, "push", "adaptive", (7.0, 2, 8.0)),
        (3, "push", "fixed_6", (9.0, 1, 12.0)),
        (4, "yield", "fixed_6", (13.0, 3, 4.0)),
        (4, "yield", "adaptive", (None, 1, 5.0)),
        (5, "push", "adaptive", (7.0, 1, 8.0)),  # as many in push
        (5, "yield", "fixed_0", (None, 0, -10.0)),
        (6, "yield", "fixed_0", (None, 2, 7.0)),
    ],
)
def test_one_that_does_better_refutes(
    traces: list[Trace], number: int, setting: str, planner: str, drive: tuple
) -> None:
    drives = {name: dict(planners) for name, planners in DRIVES.items()}
    drives[setting][planner] = drive
    assert judged(made_up(drives), traces)[number].verdict == "does not hold"


def test_aggressiveness_and_spread(traces: list[Trace]) -> None:
    assert judged(made_up(first=(0.1, 0.9)), traces)[8].verdict == "does not hold"
    assert judged(made_up(gap=(0.9, 0.3)), traces)[8].verdict == "does not hold"
    equal = {s: {p: (8.0, 0, 5.0) for p in planners} for s, planners in DRIVES.items()}
    assert judged(made_up(equal, spread=(2.0, 0.5)), traces)[9].verdict == "does not hold"
    assert judged(made_up(equal, spread=(1.0, 1.0)), traces)[9].verdict == "undecided"


def test_the_behaviour_index_is_read_from_the_drives(traces: list[Trace]) -> None:
    claim = judged(made_up(), traces)[7]
    shares = {finding.text: finding.value for finding in claim.findings}
    assert shares["push: episodes in which psi stays negative [%]"] == 100
    assert shares["yield: episodes in which psi is positive first [%]"] == 100
    assert claim.verdict == (
        "holds"
        if shares["yield: episodes in which it is positive first and negative later [%]"] > 50
        else "does not hold"
    )


def test_what_was_not_driven_is_not_tested(traces: list[Trace]) -> None:
    table = made_up()
    push = judged(table[table["setting"] == "push"], [trace for trace in traces if trace.family == "push"])
    assert push[1].verdict != "not tested"
    assert all(push[number].verdict == "not tested" for number in (4, 5, 6, 7, 8, 9))
    alone = judged(table[table["planner"] == "adaptive"], traces)
    assert all(claim.verdict == "not tested" for claim in alone.values())


def test_the_decisive_figure_is_the_clearest_against_the_claim_else_the_closest(traces: list[Trace]) -> None:
    drives = {name: dict(planners) for name, planners in DRIVES.items()}
    drives["push"] |= {"fixed_0": (8.0, 0, 9.0), "fixed_6": (9.0, 1, 12.0)}
    against, closest = judged(made_up(drives), traces)[3].decisive, judged(made_up(), traces)[3].decisive
    assert against is not None
    assert closest is not None
    assert (against.text, against.verdict) == ("reward less that of fixed 6 s", "does not hold")
    assert against.margin == pytest.approx(-4, abs=1)
    assert (closest.text, closest.verdict) == ("reward less that of fixed 0 s", "holds")
    assert judged(made_up(), traces)[10].decisive is None


def test_claims_are_plain_json(traces: list[Trace]) -> None:
    one_each = made_up().groupby(["planner", "setting"]).head(1)
    text = json.dumps([claim.as_dict() for claim in judge_claims(one_each, traces)], allow_nan=False)
    assert json.loads(text)[0]["findings"][0]["low"] is not None
