"""Comparisons with the policy: paired by task, over the tasks that both have."""

import pandas as pd
import pytest

from negopipe.evaluation.comparison import regret, versus_adaptive


def rows(planner: str, outcomes: list[str], times: list[float | None]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "planner": planner,
            "setting": "push",
            "episode": range(len(outcomes)),
            "outcome": outcomes,
            "driving_time_s": times,
            "reward": [10.0 * (outcome == "success") for outcome in outcomes],
        }
    )


OURS = rows("adaptive", ["success"] * 4, [8.0, 9.0, 10.0, 11.0])


def compared(theirs: pd.DataFrame) -> dict:
    return versus_adaptive(pd.concat([OURS, theirs]))["versus_adaptive"]["push"][theirs["planner"].iloc[0]]


def test_differences_are_of_the_same_tasks() -> None:
    found = compared(rows("fixed_6", ["success", "deadlock", "success", "success"], [9.0, None, 11.0, 12.0]))
    assert found["success"]["value"] == pytest.approx(-0.25)
    assert found["success"]["low"] <= -0.25 <= found["success"]["high"]
    assert found["driving_time_s"] == {"value": 1.0, "low": 1.0, "high": 1.0, "n_tasks": 3}
    assert found["reward"]["value"] == pytest.approx(-2.5)


def test_a_planner_may_have_driven_fewer_tasks() -> None:
    found = compared(rows("level_k", ["success"], [8.5]))
    assert found["driving_time_s"] == {"value": 0.5, "low": None, "high": None, "n_tasks": 1}


def test_who_never_arrives_has_no_time() -> None:
    found = compared(rows("fixed_0", ["collision"] * 4, [None] * 4))
    assert found["driving_time_s"] == {"value": None, "low": None, "high": None, "n_tasks": 0}
    assert found["success"]["value"] == -1.0


def test_regret_is_over_the_tasks_that_the_oracle_drove() -> None:
    lost = rows("fixed_6", ["success", "deadlock", "deadlock", "success"], [9.0, None, None, 12.0])
    oracle = rows("oracle", ["success"] * 3, [7.0] * 3)
    found = regret(pd.concat([OURS, lost, oracle]))["regret"]["push"]
    assert set(found) == {"adaptive", "fixed_6"}
    assert found["adaptive"] == {"value": 0.0, "low": 0.0, "high": 0.0, "n_tasks": 3}
    assert found["fixed_6"]["value"] == pytest.approx(20 / 3)
    assert regret(OURS) == {"regret": {"push": {}}}
