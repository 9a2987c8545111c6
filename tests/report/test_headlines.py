"""Headlines: who wins, by how much, and only where more than chance says so."""

from typing import Any

import pytest
from measured import FIXED_S, measures, versus

from negopipe.report.headlines import headline, headlines, standing


@pytest.mark.parametrize(
    ("theirs", "verdict"),
    [
        (versus(-0.4), "beats fixed 2 s by 40.0 [35.0, 45.0] points"),
        (versus(0.4), "loses to fixed 2 s by 40.0 [35.0, 45.0] points"),
        (versus(0.02, time_s=1.5), "as often as fixed 2 s and is 1.50 [1.40, 1.60] s faster"),
        (versus(0.02, time_s=-1.5), "as often as fixed 2 s and is 1.50 [1.40, 1.60] s slower"),
        (versus(0.0, half=0.0, time_s=0.01), "as often as fixed 2 s and is as fast"),
        (versus(0.0), "and fixed 2 s succeed equally often"),
    ],
)
def test_headline_says_who_wins(theirs: dict[str, Any], verdict: str) -> None:
    planners = {"adaptive": measures(0.9, 0.1, 14.0), "fixed_2": measures(0.9, 0.1, 14.0)}
    text, detail = headline("push", planners, {"fixed_2": theirs}, FIXED_S)
    assert text.startswith("Push: the adaptive planner")
    assert verdict in text.replace("\N{NO-BREAK SPACE}", " ")
    assert "90.0 % success" in detail
    assert "on the same 100 tasks" in detail


def test_two_that_never_succeed_are_not_called_reliable() -> None:
    planners = {"adaptive": measures(0.0, 0.0, None), "fixed_2": measures(0.0, 0.0, None)}
    evaluation, differences = {"yield": planners, "push": planners}, {"fixed_2": versus(0.0)}
    overall, *settings = headlines(evaluation, dict.fromkeys(evaluation, differences), FIXED_S)
    assert "neither the adaptive planner nor fixed 2" in overall[0]
    assert len(settings) == 2
    for verdict, _ in settings:
        assert verdict.endswith("neither the adaptive planner nor fixed 2\N{NO-BREAK SPACE}s ever succeeds.")


def test_one_task_says_nothing() -> None:
    unknown = versus(-1.0)
    for difference in unknown.values():
        difference |= {"low": None, "high": None, "n_tasks": 1}
    planners = {"adaptive": measures(1.0, 0.0, 14.0, n=1), "fixed_2": measures(0.0, 1.0, 14.0, n=1)}
    assert "beats" not in headline("push", planners, {"fixed_2": unknown}, FIXED_S)[0]


def test_headline_names_the_best_baseline_and_does_without_one() -> None:
    baselines = {"fixed_0": measures(0.1, 0.9, 8.0), "fixed_6": measures(0.6, 0.0, 15.0)}
    differences = {"fixed_0": versus(-0.8), "fixed_6": versus(-0.3)}
    text, detail = headline("yield", {"adaptive": measures(0.9, 0.1, 14.0), **baselines}, differences, FIXED_S)
    assert "fixed 6" in text
    assert "15.0 s" in detail
    alone, _ = headline("yield", {"adaptive": measures(0.9, 0.1, None)}, {}, FIXED_S)
    assert "never arrives" in alone


def test_the_oracle_is_nobodys_baseline_and_may_have_driven_in_one_setting_only() -> None:
    planners = {"adaptive": measures(0.9, 0.0, 14.0), "fixed_6": measures(0.2, 0.0, 15.0)}
    evaluation = {"yield": planners, "push": {**planners, "oracle": measures(1.0, 0.0, 12.0)}}
    differences = {"fixed_6": versus(-0.7), "oracle": versus(0.1)}
    verdicts = headlines(evaluation, dict.fromkeys(evaluation, differences), FIXED_S)
    assert len(verdicts) == 3
    assert all("fixed 6" in verdict and "oracle" not in verdict for verdict, _ in verdicts)
    assert standing(evaluation, dict.fromkeys(evaluation, differences)) == "ahead"


def test_first_headline_is_about_all_settings() -> None:
    evaluation = {
        "yield": {
            "adaptive": measures(0.97, 0.0, 14.0),
            "fixed_0": measures(0.0, 1.0, None),
            "fixed_6": measures(1.0, 0.0, 14.0),
        },
        "push": {
            "adaptive": measures(1.0, 0.0, 8.0),
            "fixed_0": measures(1.0, 0.0, 8.0),
            "fixed_6": measures(0.1, 0.0, 15.0),
        },
    }
    differences = {
        "yield": {"fixed_0": versus(-0.97), "fixed_6": versus(0.03)},
        "push": {"fixed_0": versus(0.0), "fixed_6": versus(-0.9)},
    }
    (verdict, detail), *others = headlines(evaluation, differences, FIXED_S)
    assert "succeeds more reliably than fixed 6" in verdict
    detail = detail.replace("\N{NO-BREAK SPACE}", " ")
    assert (
        "weakest settings, adaptive succeeds in 97.0 % of the episodes of yield; fixed 6 s succeeds in 10.0 %" in detail
    )
    assert [verdict.split(":")[0] for verdict, _ in others] == ["Yield", "Push"]
    evaluation["push"]["fixed_6"] = measures(0.95, 0.0, 15.0)
    level, rewards = headlines(evaluation, differences, FIXED_S)[0]
    assert "succeeds as reliably as fixed 6" in level
    assert rewards.endswith("Reward: 4.70 against 5.00 (yield), 5.00 against 4.50 (push).")
    evaluation["yield"]["adaptive"] = measures(0.5, 0.0, 14.0)
    assert "succeeds less reliably than fixed 6" in headlines(evaluation, differences, FIXED_S)[0][0]
    assert len(headlines({"yield": evaluation["yield"]}, differences, FIXED_S)) == 1


@pytest.mark.parametrize(
    ("theirs", "expected"), [(versus(0.016, half=0.014), "behind"), (versus(0.016), "level"), (versus(-0.1), "ahead")]
)
def test_two_that_are_weakest_in_the_same_setting_are_compared_on_its_tasks(
    theirs: dict[str, Any], expected: str
) -> None:
    planners = {"adaptive": measures(0.972, 0.02, 12.0), "cautious": measures(0.988, 0.01, 14.0)}
    easy = {"adaptive": measures(1.0, 0.0, 12.0), "cautious": measures(1.0, 0.0, 14.0)}
    differences = {"mixture": {"cautious": versus(0.0)}, "mixture_switching": {"cautious": theirs}}
    assert standing({"mixture": easy, "mixture_switching": planners}, differences) == expected


@pytest.mark.parametrize(("success", "said"), [(-0.4, "reward is 4.00 [3.00, 5.00] higher"), (0.4, "lower"), (0.0, "")])
def test_the_difference_in_reward_is_told_where_there_is_one(success: float, said: str) -> None:
    planners = {"adaptive": measures(0.9, 0.1, 14.0), "fixed_2": measures(0.9, 0.1, 14.0)}
    detail = headline("push", planners, {"fixed_2": versus(success)}, FIXED_S)[1]
    assert said in detail
    assert ("planner's reward is" in detail) == bool(said)
