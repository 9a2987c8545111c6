"""The oracle stage: its tasks are the evaluation's, its files agree with the drives, wrong values are named."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from composed import compose_config
from games import tiny_config
from tracked import RecordedRun

from negopipe.config.root import RunConfig, run_name
from negopipe.errors import UserError
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.game.game import Game
from negopipe.runtime.build import build, save_policy
from negopipe.search import oracle as search
from negopipe.search.oracle_table import read_oracle
from negopipe.stages import evaluate, oracle
from negopipe.tracking.checkpoint import CHECKPOINT_NAME

TINY = (
    "oracle.settings=[push,mixture]",
    "oracle.n_episodes=2",
    "oracle.population=3",
    "oracle.rounds=1",
    "scenario.episode_steps=56",
)


IN_PUSH = ("evaluation.settings=[push]",)


def tiny(*overrides: str) -> RunConfig:
    return tiny_config("oracle", *TINY, *overrides)


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    run = RecordedRun(tmp_path_factory.mktemp("run"))
    with pytest.MonkeyPatch.context() as patch:  # a coarse grid to start from, for time
        patch.setattr(search, "SWITCH_STEPS", (8,))
        patch.setattr(search, "SWITCH_PAIRS", ())
        oracle.run(tiny(), run)
    return run


def with_its_oracle(table: Path, *overrides: str) -> RunConfig:
    """The evaluation of a fresh policy on the tasks of `ran`."""
    return tiny(
        *(f"evaluation.oracle={table}", "evaluation/baseline=[fixed_0]", "evaluation.settings=[push,yield]"),
        *("evaluation.leading_setting=push", "evaluation.n_episodes=3"),
        *("policy.conv=[{channels: 4, kernel: 8, stride: 4}]", "policy.encoder_width=16", *overrides),
    )


def evaluated(config: RunConfig, folder: Path) -> RecordedRun:
    run = RecordedRun(folder)
    _, policy = build(config)
    save_policy(folder / CHECKPOINT_NAME, policy, config, 0)
    evaluate.run(config, run)
    return run


def test_what_was_found_can_be_driven_as_a_planner(ran: RecordedRun, tmp_path: Path) -> None:
    evaluated(with_its_oracle(ran.folder / "oracle.csv"), tmp_path)
    table = pd.read_csv(tmp_path / "episodes.csv").query("planner == 'oracle'")
    found = pd.read_csv(ran.folder / "oracle.csv").query("setting == 'push'")
    assert table["setting"].tolist() == ["push", "push"]  # it was not searched in yield
    for column in ("episode", "outcome", "horizons"):
        assert table[column].tolist() == found[column].tolist()
    assert table["reward"].tolist() == pytest.approx(found["reward"].tolist())


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["scenario.road.corridor_length_m=16.0"], "must be of this road, planner and reward"),
        (["scenario.episode_steps=20"], "planner and reward and return .* got longer episodes"),
        (
            ["evaluation.n_episodes=1", "oracle.n_episodes=1"],
            "must be of the first of the 1 tasks of push, got 2 tasks up to 1",
        ),
    ],
)
def test_what_was_found_for_other_tasks_is_refused(
    ran: RecordedRun, tmp_path: Path, overrides: list[str], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        evaluated(with_its_oracle(ran.folder / "oracle.csv", *IN_PUSH, *overrides), tmp_path)


def test_a_part_of_what_was_found_is_refused(ran: RecordedRun, tmp_path: Path) -> None:
    table = pd.read_csv(ran.folder / "oracle.csv")
    table[table["episode"] > 0].to_csv(tmp_path / "oracle.csv", index=False)
    with pytest.raises(UserError, match="got 1 tasks up to 1"):
        evaluated(with_its_oracle(tmp_path / "oracle.csv", *IN_PUSH), tmp_path)


def test_an_oracle_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"evaluation\.oracle must be pretrained or an oracle\.csv .* no such file"):
        read_oracle(str(tmp_path / "oracle.csv"))
    (tmp_path / "oracle.csv").write_text("setting,episode\npush,0\n")
    with pytest.raises(UserError, match=r"with horizons: .*must have a column horizons"):
        read_oracle(str(tmp_path / "oracle.csv"))


@pytest.mark.slow
def test_what_comes_with_negopipe_is_driven_on_its_tasks(tmp_path: Path) -> None:
    evaluated(with_its_oracle(Path("pretrained"), "scenario.episode_steps=128"), tmp_path)
    table = pd.read_csv(tmp_path / "episodes.csv").query("planner == 'oracle'").reset_index()
    assert table["setting"].tolist() == ["push"] * 3 + ["yield"] * 3
    shipped = read_oracle("pretrained").rows
    for setting, rows in table.groupby("setting"):
        of_setting = shipped[shipped["setting"] == setting].head(3)
        assert rows["horizons"].tolist() == of_setting["horizons"].tolist()
        assert rows["reward"].tolist() == pytest.approx(of_setting["reward"].tolist())


@pytest.mark.slow
@pytest.mark.parametrize(
    "other", ["scenario.road.corridor_length_m=11.0", "evaluation.task_seed=1", "scenario.episode_steps=40"]
)
def test_what_comes_with_negopipe_is_left_out_elsewhere(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, other: str
) -> None:
    with caplog.at_level("INFO", "negopipe"):
        evaluated(with_its_oracle(Path("pretrained"), "scenario.episode_steps=128", other), tmp_path)
    assert set(pd.read_csv(tmp_path / "episodes.csv")["planner"]) == {"adaptive", "fixed_0"}
    assert "push       without oracle: the table that comes with negopipe is for another road" in caplog.text


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
        part.write_text(f"setting,reward,ego_time_s\n{setting},0.1,\n{setting},-1e-17,2\n")

    monkeypatch.setattr(oracle, "_search", mortal)
    run = RecordedRun(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        oracle.run(tiny(), run)  # type: ignore[arg-type]
    oracle.run(tiny(), run)  # type: ignore[arg-type]
    assert searched == ["push", "mixture", "mixture"]
    rows = "push,0.1,\npush,-1e-17,2\nmixture,0.1,\nmixture,-1e-17,2\n"
    assert (tmp_path / "oracle.csv").read_text() == f"setting,reward,ego_time_s\n{rows}"
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
        (
            "oracle.settings=[rest]",
            "oracle.settings must be among push, yield, mixture, mixture_switching of scenario.families, got rest",
        ),
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
