"""The dashboard's description of a run says what it is and how it went."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from composed import compose_config
from tracked import RecordedRun

from negopipe.evaluation.comparison import versus_adaptive
from negopipe.evaluation.measures import summary
from negopipe.report.description import log_summary, run_description


def episodes(planner: str, setting: str, n_successes: int) -> pd.DataFrame:
    is_success = np.arange(100) < n_successes
    return pd.DataFrame(
        {
            "planner": planner,
            "setting": setting,
            "episode": range(100),
            "outcome": np.where(is_success, "success", "collision"),
            "driving_time_s": np.where(is_success, 9.0, np.nan),
            "social_time_s": np.where(is_success, 12.0, np.nan),
            "suspend_count": 0,
            "suspend_time_s": 0.0,
            "full_braking_count": 0,
            "passes_first": "ego",
            "reward": np.where(is_success, 1.0, -9.0),
        }
    )


@pytest.mark.parametrize(("theirs", "standing"), [(20, "ahead"), (90, "level"), (100, "behind")])
def test_it_says_what_it_is_and_how_it_went(tmp_path: Path, theirs: int, standing: str) -> None:
    run = RecordedRun(tmp_path)
    table = pd.concat(
        episodes(planner, setting, n)
        for setting in ("push", "yield")
        for planner, n in (("adaptive", 90), ("fixed_2", theirs))
    )
    log_summary(compose_config(["+experiment=yield", "seed=3"]), run, summary(table) | versus_adaptive(table))
    assert run.tags == {"standing": standing}
    what, over_all, yielding, pushing = run.description.split("\n\n")
    assert what.startswith("yield, seed 3: a policy trained by acktr, decisions by stage: wait 163,840, both 573,440.")
    assert "held-out tasks each of push and yield, against fixed 0\N{NO-BREAK SPACE}s, fixed 2" in what
    assert over_all.startswith("Over all settings the adaptive planner succeeds")
    assert (yielding[:5], pushing[:4]) == ("Yield", "Push")


def test_a_policy_from_elsewhere_is_named() -> None:
    config = compose_config(
        ["+experiment=mixture", "stages=[evaluate]", "checkpoint=pretrained", "evaluation/baseline=[]"]
    )
    assert "the policy of checkpoint pretrained." in run_description(config)
    assert run_description(config).endswith("each of mixture and mixture switching, against no baseline.")


def test_what_is_not_evaluated_is_not_said_to_be() -> None:
    assert run_description(compose_config(["+experiment=yield", "stages=[train]"])).endswith("both 573,440.")


def test_the_description_names_the_demonstrations() -> None:
    what = run_description(compose_config(["+experiment=yield", "stages=[train]", "curriculum=demonstrations"]))
    assert what.endswith(": full 327,680, with demonstrations of a search with full knowledge on 128 training tasks.")
