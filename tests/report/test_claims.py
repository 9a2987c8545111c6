"""Claims: what holds, what does not, what is left open; on made-up evaluations in which that is known."""

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from measured import FIXED_S

from negopipe.evaluation.claims import judge_claims
from negopipe.evaluation.hypothesis import Claim
from negopipe.evaluation.names import FixedHorizons
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


def judged(table: pd.DataFrame, traces: list[Trace], fixed_s: FixedHorizons = FIXED_S) -> dict[int, Claim]:
    return {claim.number: claim for claim in judge_claims(table, traces, fixed_s)}


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
        if shares["yield: episodes in which psi is positive first and negative later [%]"] > 50
        else "does not hold"
    )


def test_what_was_not_driven_is_not_tested(traces: list[Trace]) -> None:
    table = made_up()
    push = judged(table[table["setting"] == "push"], [trace for trace in traces if trace.setting == "push"])
    assert push[1].verdict != "not tested"
    assert all(push[number].verdict == "not tested" for number in (4, 5, 6, 7, 8, 9))
    alone = judged(table[table["planner"] == "adaptive"], traces)
    assert all(claim.verdict == "not tested" for claim in alone.values())


@pytest.mark.parametrize("kept", [names for n in range(5) for names in combinations(FIXED_S, n)])
def test_any_fixed_horizons_can_be_judged(traces: list[Trace], table: pd.DataFrame, kept: tuple[str, ...]) -> None:
    found = judged(table[table["planner"].isin(["adaptive", *kept])], traces)
    assert (found[8].verdict == "not tested") == (len(kept) < 2)
    for number in range(1, 10):
        assert kept or found[number].verdict == "not tested"
    compared = [finding.text for finding in found[8].findings]
    assert len(compared) == len(set(compared))


def test_what_a_planner_is_called_changes_no_verdict(traces: list[Trace]) -> None:
    called = {"fixed_0": "fixed_short", "fixed_6": "nan", "adaptive": "adaptive"}
    renamed = made_up().assign(planner=lambda table: table["planner"].map(called))
    found, as_usual = judged(renamed, traces, {"fixed_short": 0.0, "nan": 6.0}), judged(made_up(), traces)
    assert {n: claim.verdict for n, claim in found.items()} == {n: claim.verdict for n, claim in as_usual.items()}
    assert found[3].findings[0].text == "reward minus that of fixed short (0 s)"
    unknown = judged(made_up(), traces, {})  # they sound like fixed horizons, and are none
    assert {claim.verdict for claim in unknown.values()} == {"not tested"}


def test_equal_horizons_are_not_compared_with_each_other(traces: list[Trace]) -> None:
    assert judged(made_up(), traces, {"fixed_0": 2.0, "fixed_6": 2.0})[8].verdict == "not tested"


def test_a_single_episode_is_not_enough_to_tell(traces: list[Trace]) -> None:
    found = judged(made_up().groupby(["planner", "setting"]).head(1), traces)
    assert {found[number].verdict for number in (2, 3, 5, 6)} == {"undecided"}


def test_claims_of_the_papers_settings_are_not_tested_in_others(traces: list[Trace]) -> None:
    elsewhere = made_up().assign(setting="elsewhere")
    found = judged(elsewhere, [replace(trace, setting="elsewhere") for trace in traces])
    assert {claim.verdict for claim in found.values()} == {"not tested"}


def test_the_decisive_figure_is_the_clearest_against_the_claim_else_the_closest(traces: list[Trace]) -> None:
    drives = {name: dict(planners) for name, planners in DRIVES.items()}
    drives["push"] |= {"fixed_0": (8.0, 0, 9.0), "fixed_6": (9.0, 1, 12.0)}
    against, closest = judged(made_up(drives), traces)[3].decisive, judged(made_up(), traces)[3].decisive
    assert against is not None
    assert closest is not None
    assert (against.text, against.verdict) == ("reward minus that of fixed 6 s", "does not hold")
    assert against.margin == pytest.approx(-4, abs=1)
    assert (closest.text, closest.verdict) == ("reward minus that of fixed 0 s", "holds")
    assert judged(made_up(), traces)[10].decisive is None


def test_claims_are_plain_json(traces: list[Trace]) -> None:
    one_each = made_up().groupby(["planner", "setting"]).head(1)
    text = json.dumps([claim.as_dict() for claim in judge_claims(one_each, traces, FIXED_S)], allow_nan=False)
    assert json.loads(text)[0]["findings"][0]["low"] is not None
