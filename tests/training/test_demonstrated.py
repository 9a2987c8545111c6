"""Demonstrations of a training: found on tasks of its own, better than any fixed horizon, kept and taken up again."""

from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
import torch
from composed import compose_config
from killed import SMALL, drive

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.game.game import Game, build_game
from negopipe.search import oracle
from negopipe.training.demonstration_search import demonstrated_tasks, demonstrations

SHOWN = "curriculum.demonstrations={n_tasks: 3, population: 2, rounds: 1, n_decisions: 16, weight: 1.0, until: 0.6}"


@pytest.fixture(scope="module", autouse=True)
def few_switches() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:  # a coarse grid to start from, for time
        patch.setattr(oracle, "SWITCH_STEPS", (8, 24))
        yield


@pytest.fixture(scope="module")
def shown_config() -> RunConfig:
    return compose_config(["+experiment=yield", "scenario.episode_steps=72", SHOWN])


@pytest.fixture(scope="module")
def shown_game(shown_config: RunConfig) -> Game:
    return build_game(shown_config)


@pytest.fixture(scope="module")
def folder(shown_config: RunConfig, shown_game: Game, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("shown")
    assert demonstrations(shown_config, shown_game, place) is not None
    return place


@pytest.mark.slow
def test_they_are_successes_and_kept(shown_config: RunConfig, shown_game: Game, folder: Path) -> None:
    table = pd.read_csv(folder / "demonstrations.csv")
    assert table["family"].tolist() == ["push"] * 3 + ["yield"] * 3
    assert (table["reward"] > -8).all()  # a crash is below -10
    before = (folder / "demonstrations.csv").stat().st_mtime_ns
    assert demonstrations(shown_config, shown_game, folder) is not None
    assert (folder / "demonstrations.csv").stat().st_mtime_ns == before


@pytest.mark.slow
def test_the_policy_is_shown_what_it_would_see(shown_config: RunConfig, shown_game: Game, folder: Path) -> None:
    table = pd.read_csv(folder / "demonstrations.csv")
    shown = demonstrations(shown_config, shown_game, folder)
    assert shown is not None
    n_decisions = sum(
        int(n or 1) for text in table["horizons"] for _, _, n in (run.partition("x") for run in text.split())
    )
    assert len(shown.action) == len(shown.observation) == n_decisions
    tasks = demonstrated_tasks(shown_config, shown.config, shown_game)["push"]
    world = shown_game.simulator.reset(tasks)
    assert torch.equal(shown.observation[:3], shown_game.see(world))
    horizon = world.horizons(torch.tensor(shown_config.policy.horizons_s)[shown.action[:3]])
    assert torch.equal(shown.observation[3:6], shown_game.see(shown_game.drive(world, horizon).world))


def test_its_tasks_are_training_tasks_and_not_held_out(shown_config: RunConfig, shown_game: Game) -> None:
    assert shown_config.curriculum.demonstrations is not None
    for name, tasks in demonstrated_tasks(shown_config, shown_config.curriculum.demonstrations, shown_game).items():
        held_out = held_out_tasks(shown_config, shown_game, name).start_distance
        assert not torch.isin(tasks.start_distance[:, 1:], held_out[:, 1:]).any()
        low, high = shown_config.curriculum.stages[-1].families[name].start_distance_m
        assert ((tasks.start_distance[:, 1:] >= low) & (tasks.start_distance[:, 1:] <= high)).all()


@pytest.mark.slow
def test_a_training_that_is_shown_something_resumes(tmp_path: Path) -> None:
    few = SHOWN.replace("n_tasks: 3", "n_tasks: 1")
    whole, killed = (drive(tmp_path / f"{len(d)}", few, deaths=d) for d in ((), (2,)))
    assert killed[0] == whole[0]
    pd.testing.assert_frame_equal(killed[1], whole[1], check_exact=True)
    files = [(tmp_path / name / "demonstrations.csv").read_bytes() for name in "01"]
    assert files[0] == files[1]


def test_a_search_needs_a_reward_that_it_can_give_up_on() -> None:
    with pytest.raises(UserError, match="reward must have step <= 0"):
        compose_config([*SMALL, SHOWN, "reward.step=0.1"])
