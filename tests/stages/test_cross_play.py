"""Cross-play: the cast drives the ego as it drives the others, seats are alike, rows agree with the drives."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch
from composed import compose_config
from games import tiny_config
from tracked import RecordedRun

from negopipe.agents.driver import fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.evaluation.episodes import by_cast, drive_episodes
from negopipe.evaluation.trace import Trace
from negopipe.game.game import Game, build_game
from negopipe.runtime.build import build, save_policy
from negopipe.simulation.state import EGO, NOBODY, Task
from negopipe.stages import cross_play
from negopipe.tensors.tree import map_tensors

PLAYERS = (
    "population/driver=[any_horizon,cautious,give_way,idm]",
    "population.drivers.any_horizon.driver.interval_s=[2.0,2.0]",
    "population.drivers.give_way.weight=0.0",
    "population.drivers.idm.weight=0.0",
    "cross_play.n_episodes=6",
)


def tiny(*overrides: str) -> RunConfig:
    return tiny_config("cross_play", *PLAYERS, *overrides)


@pytest.fixture(scope="module")
def played() -> tuple[RunConfig, Game]:
    config = tiny()
    return config, build_game(config)


def record(config: RunConfig, game: Game, tasks: Task) -> Trace:
    return drive_episodes(game, by_cast, tasks, 64, config.evaluation.reward, ("pair", "mixture"))


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    run = RecordedRun(tmp_path_factory.mktemp("run"))
    cross_play.run(tiny("report.figure_formats=[svg]"), run)
    return run


def test_every_driver_with_a_weight_meets_every_other_in_both_seats(ran: RecordedRun) -> None:
    table = pd.read_csv(ran.folder / "cross_play.csv")
    names = ["any_horizon", "cautious"]
    assert list(zip(table["ego"], table["social"], strict=True)) == [(a, b) for a in names for b in names]
    assert (table["n_episodes"] == 6).all()
    assert ran.artifacts == [("cross_play.csv", ""), ("cross_play_mixture.svg", "figures")]
    svg = (ran.folder / "figures" / "cross_play_mixture.svg").read_text()
    assert "success [%]" in svg
    waits = table[table["ego"] == "cautious"]
    assert (waits["collision_rate"] == 0).all()
    assert (table["success_low"] <= table["success_rate"]).all()
    assert (table["success_rate"] <= table["success_high"]).all()


def test_rows_agree_with_the_drives(ran: RecordedRun, played: tuple[RunConfig, Game]) -> None:
    config, game = played
    table = pd.read_csv(ran.folder / "cross_play.csv").set_index(["ego", "social"])
    trace = record(config, game, cross_play.pair_tasks(config, game, ("mixture", "any_horizon", "cautious")))
    row = table.loc[("any_horizon", "cautious")]
    assert row["success_rate"] == (trace.outcome == 0).mean()
    assert row["ego_time_s"] == pytest.approx((trace.reached_step[:, EGO] * trace.dt_s).mean())
    assert (trace.driver[:, EGO] == "any_horizon").all()
    assert (trace.driver[:, EGO + 1] == "cautious").all()


def test_a_driver_of_the_cast_drives_the_ego_as_its_baseline_does(played: tuple[RunConfig, Game]) -> None:
    config, game = played
    tasks = cross_play.pair_tasks(config, game, ("mixture", "any_horizon", "give_way"))
    nobody = tasks.casting.driver.clone()
    nobody[:, EGO] = NOBODY
    outside = replace(tasks, casting=replace(tasks.casting, driver=nobody))
    paid = config.evaluation.reward
    baseline = drive_episodes(game, by_horizon(game, fixed_horizon(2.0)), outside, 64, paid, ("pair", "mixture"))
    trace = record(config, game, tasks)
    assert (trace.position_m == baseline.position_m).all()
    assert (trace.horizon_s[0, :, EGO] == 2.0).all()


def mirrored(tasks: Task) -> Task:
    """The tasks with everything of the two vehicles exchanged but their places in the lanes."""
    swapped = map_tensors(lambda field: field.flip(1) if field.dim() > 1 else field, tasks)
    return replace(swapped, direction=tasks.direction)


def test_mirrored_tasks_give_mirrored_outcomes(played: tuple[RunConfig, Game]) -> None:
    config, game = played
    tasks = cross_play.pair_tasks(config, game, ("mixture", "give_way", "cautious"))
    there, back = record(config, game, tasks), record(config, game, mirrored(tasks))
    assert torch.equal(mirrored(tasks).casting.driver.flip(1), tasks.casting.driver)
    n = min(there.n_steps.min(), back.n_steps.min())
    torch.testing.assert_close(there.progress_m[:n], back.progress_m[:n, :, ::-1].copy(), atol=1e-2, rtol=0)
    assert ((there.outcome == 0) == (back.outcome == 0)).all()


def test_symmetric_starts_leave_no_difference_between_the_seats(played: tuple[RunConfig, Game]) -> None:
    _, game = played
    config = tiny("cross_play.is_symmetric=true")
    tasks = cross_play.pair_tasks(config, game, ("mixture", "cautious", "cautious"))
    for name in ("start_distance", "start_speed", "desired_speed", "length", "width"):
        field = getattr(tasks, name)
        assert torch.equal(field[:, EGO], field[:, EGO + 1]), name
    drawn = cross_play.pair_tasks(tiny(), game, ("mixture", "cautious", "cautious"))
    assert torch.equal(drawn.start_distance[:, EGO], tasks.start_distance[:, EGO])
    assert not torch.equal(drawn.start_distance, tasks.start_distance)


def test_the_policy_of_the_run_plays_as_self(tmp_path: Path) -> None:
    small = ("policy.trunk_widths=[16]", "policy.own_widths=[8]", "cross_play.n_episodes=2")
    brief = "scenario.episode_steps=12"
    config = tiny_config("cross_play", "population/driver=[cautious,self]", *small, brief)
    run = RecordedRun(tmp_path)
    with pytest.raises(UserError, match="checkpoint must be a file or an MLflow run id"):
        cross_play.run(config, run)
    save_policy(tmp_path / "checkpoint.safetensors", build(config)[1], config, 0)
    cross_play.run(config, run)
    table = pd.read_csv(tmp_path / "cross_play.csv")
    assert list(table["ego"].unique()) == ["cautious", "self"]


def test_a_driver_without_horizons_of_its_own_is_refused() -> None:
    with pytest.raises(UserError) as error:
        compose_config(["+experiment=cross_play", "population=styles"])
    assert str(error.value).startswith("population.drivers.planner.driver must have horizons_s or interval_s for the")
