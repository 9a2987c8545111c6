"""The oracle stage: its tasks are the evaluation's, its files agree with the drives, wrong values are named."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from tracked import RecordedRun

from negopipe.config import RunConfig, run_name
from negopipe.env import Game
from negopipe.errors import UserError
from negopipe.evaluation import oracle as search
from negopipe.gym_env import compose_config
from negopipe.stages import oracle
from negopipe.stages.evaluate import held_out_tasks

TINY = (
    "+experiment=oracle",
    "oracle.settings=[push,mixture]",
    "oracle.n_episodes=2",
    "oracle.population=3",
    "oracle.rounds=1",
    "scenario.episode_steps=72",
    "compile='off'",
)


def tiny(*overrides: str) -> RunConfig:
    return compose_config(["device=cpu", *TINY, *overrides])


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    run = RecordedRun(tmp_path_factory.mktemp("run"))
    with pytest.MonkeyPatch.context() as patch:  # a coarse grid to start from, for time
        patch.setattr(search, "SWITCH_STEPS", (8, 24))
        patch.setattr(search, "SWITCH_PAIRS", ((8, 24),))
        oracle.run(tiny(), run)
    return run


def test_a_row_per_task_and_measures_that_agree(ran: RecordedRun) -> None:
    assert ran.artifacts == [("oracle.csv", "")]
    table = pd.read_csv(ran.folder / "oracle.csv")
    assert table[["setting", "episode"]].to_numpy().tolist() == [[s, i] for s in ("push", "mixture") for i in (0, 1)]
    assert (table["reward"] >= table["best_fixed_reward"]).all()
    assert table["best_fixed_horizon_s"].isin([0.0, 2.0, 4.0, 6.0]).all()
    assert set(ran.sections["oracle"]) == {"push", "mixture"}
    for setting, measures in ran.sections["oracle"].items():
        rows = table[table["setting"] == setting]
        assert measures["n_tasks"] == len(rows)
        assert measures["reward"] == pytest.approx(rows["reward"].mean())
        assert measures["success_rate"] == (rows["outcome"] == "success").mean()
        assert measures["gain_by_doubling"] == pytest.approx(measures["reward"] - measures["reward_at_half_budget"])
        assert measures["is_converged"] == (measures["gain_by_doubling"] < oracle.CONVERGED)
        assert list(measures["fixed"]) == ["fixed_0", "fixed_2", "fixed_4", "fixed_6"]
        assert max(each["reward"] for each in measures["fixed"].values()) <= rows["best_fixed_reward"].mean()


def test_a_search_that_is_stopped_goes_on_with_the_setting_it_was_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched = []

    def mortal(config: RunConfig, game: Game, run: RecordedRun, setting: str, part: Path, progress: Any) -> None:
        searched.append(setting)
        if searched == ["push", "mixture"]:
            raise KeyboardInterrupt
        part.parent.mkdir(exist_ok=True)
        part.write_text(f"setting,reward,time\n{setting},0.1,\n{setting},-1e-17,2\n")

    monkeypatch.setattr(oracle, "_search", mortal)
    run = RecordedRun(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        oracle.run(tiny(), run)  # type: ignore[arg-type]
    oracle.run(tiny(), run)  # type: ignore[arg-type]
    assert searched == ["push", "mixture", "mixture"]
    rows = "push,0.1,\npush,-1e-17,2\nmixture,0.1,\nmixture,-1e-17,2\n"
    assert (tmp_path / "oracle.csv").read_text() == f"setting,reward,time\n{rows}"
    assert not (tmp_path / "oracle").exists()


def test_the_tasks_are_the_first_of_the_evaluation(config: RunConfig, game: Game) -> None:
    own = oracle.oracle_tasks(tiny(), game, "mixture")
    evaluated = held_out_tasks(config, game, "mixture")
    assert len(own) == 2
    assert torch.equal(own.start_distance, evaluated.start_distance[:2])
    assert torch.equal(own.style_horizon[:, 1], evaluated.style_horizon[:2, 1])
    assert torch.equal(own.noise_seed, evaluated.noise_seed[:2])


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("oracle.settings=[rest]", "oracle.settings must be among push, yield, mixture, mixture_switching, got rest"),
        ("oracle.n_episodes=501", "oracle.n_episodes must be at most evaluation.n_episodes = 500, got 501"),
        ("oracle.rounds=0", "oracle.rounds must be greater than or equal to 1, got 0"),
        ("evaluation.reward.step=0.1", "evaluation.reward must have step <= 0, collision <= 0 and success >= 0"),
    ],
)
def test_a_wrong_oracle_is_named(override: str, line: str) -> None:
    with pytest.raises(UserError) as error:
        tiny(override)
    assert str(error.value).startswith(line)


def test_the_oracle_names_a_run_only_where_it_is_sought() -> None:
    assert run_name(tiny("oracle.rounds=2")) != run_name(tiny())
    assert run_name(compose_config(["oracle.rounds=2"])) == run_name(compose_config())
