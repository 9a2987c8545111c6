"""A car of commonroad-vehicle-models drives encounters through the runtime."""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from composed import compose_config
from games import IN_ONE_PROCESS
from runtime_drives import negotiator, parts

from negopipe.agents.horizon_drivers import adaptive_planner, by_horizon
from negopipe.deployment.vehicle import __main__ as command
from negopipe.deployment.vehicle.cars import CARS, PERFECT, tracked
from negopipe.deployment.vehicle.encounters import Encounters
from negopipe.deployment.vehicle.multi_body import MultiBody
from negopipe.deployment.vehicle.rows import KEYS, add_rows, missing, read_rows, rows_of
from negopipe.deployment.vehicle.summary import summary
from negopipe.errors import UserError
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.tensors.tree import map_tensors

TASKS = ("+experiment=yield", *IN_ONE_PROCESS, "evaluation.n_episodes=4", "scenario.episode_steps=100")


def encounters(*overrides: str) -> Encounters:
    return Encounters(compose_config([*TASKS, *overrides]), negotiator)


def row(episode: int, outcome: str, car: str = "bmw_320i") -> pd.DataFrame:
    """A row of a table with made-up numbers."""
    numbers = dict.fromkeys(
        ("left_rms_m", "left_p95_m", "left_max_m", "ahead_rms_m", "ahead_p95_m", "ahead_max_m", "smallest_gap_m",
         "largest_decel_mps2", "largest_jerk_mps3", "ego_time_s"), 1.0 + episode,
    )  # fmt: skip
    counts = {"n_decisions": 10, "intervention_count": episode, "full_braking_count": 0}
    keys = {"policy": "some", "car": car, "setting": "push", "episode": episode}
    return pd.DataFrame([{**keys, "outcome": outcome, **counts, **numbers}])


def test_the_table_is_continued_and_no_encounter_stands_there_twice(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    for episode, outcome in ((2, "success"), (0, "collision"), (2, "collision")):
        add_rows(path, row(episode, outcome))
    table = read_rows(path)
    assert table[[*KEYS, "outcome"]].values.tolist() == [
        ["some", "bmw_320i", "push", 0, "collision"],
        ["some", "bmw_320i", "push", 2, "collision"],
    ]
    assert missing(table, "some", "bmw_320i", "push", 4) == [1, 3]
    assert missing(table, "some", "perfect", "push", 2) == [0, 1]


def test_the_summary_counts_outcomes_and_averages_errors() -> None:
    (found,) = summary(pd.concat([row(0, "success"), row(1, "collision")])).to_dict("records")
    assert found["tasks"] == 2
    assert found["success"].startswith("50.0 [")
    assert found["collisions"].startswith("50.0 [")
    assert found["left_max_m"] == 2.0
    assert found["left_rms_m"] == pytest.approx(np.sqrt(2.5), abs=1e-3)
    assert found["interventions"] == 0.5


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["perception=noisy"], "perception must be perfect"),
        (["dynamics=bicycle"], "dynamics must be perfect"),
        (["safety=rss"], "safety must be none"),
    ],
)
def test_tasks_do_nothing_to_the_ego_that_its_car_does(overrides: list[str], said: str) -> None:
    with pytest.raises(UserError, match=said):
        encounters(*overrides)


@pytest.mark.parametrize(
    ("cars", "tasks", "said"), [("trabant", 1, "--cars must be of ford_escort"), (PERFECT, 9, "--tasks must be 1 to")]
)
def test_the_command_says_what_is_wrong(cars: str, tasks: int, said: str, tmp_path: Path) -> None:
    given = argparse.Namespace(
        export=tmp_path, table=tmp_path / "t.csv", overrides=[*TASKS], cars=cars, tasks=tasks, processes=1
    )
    with pytest.raises(UserError, match=said):
        command.drive_missing(given)


def test_a_car_without_its_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("negopipe.deployment.vehicle.multi_body.NUMBERS", {"ford_escort": 9})
    with pytest.raises(UserError, match=r"negopipe\[vehicle\]"):
        MultiBody("ford_escort")


@pytest.mark.slow
@pytest.mark.parametrize("car", CARS)
def test_cars_drive_the_paper_s_tasks(car: str) -> None:
    if car != PERFECT:
        pytest.importorskip("vehiclemodels")
    where = encounters()
    driven = where.drive(car, "yield", [0, 1])
    table = rows_of(where.config, driven, "yield", car, [0, 1])
    assert set(table["outcome"]) == {"success"}
    assert set(table["stop_count"]) == {0}
    errors = np.abs(np.concatenate([tracked(vehicle.car.samples) for vehicle in driven.vehicles]))
    if car == PERFECT:
        assert errors.max() == pytest.approx(0.0, abs=1e-6)
    else:
        assert 0.001 < errors[:, 1].max() < 0.2
        assert errors[:, 0].max() < 0.7


@pytest.mark.slow
def test_a_car_without_errors_drives_as_the_simulator_does() -> None:
    exact = {name: "0.0" for name in ("seen_before_s", "lost_frames", "lost_objects")}
    exact |= {f"{name}": "0.0" for name in ("position_std_m", "yaw_std_rad", "speed_std_mps")}
    where = encounters("vehicle.objects.latency_s=[0.0,0.0]", *(f"vehicle.objects.{k}={v}" for k, v in exact.items()))
    config, game = where.config, where.game
    choose = adaptive_planner(parts()[2], game, config.policy.horizons_s)
    tasks = map_tensors(lambda field: field[:2], held_out_tasks(config, game, "yield"))
    wanted = drive_episodes(game, by_horizon(game, choose), tasks, 2, config.evaluation.reward, ("policy", "yield"))
    found = where.drive(PERFECT, "yield", [0, 1]).trace
    assert found.n_steps.tolist() == wanted.n_steps.tolist()
    for row, n in enumerate(wanted.n_steps):
        np.testing.assert_allclose(found.position_m[: n + 1, row], wanted.position_m[: n + 1, row], atol=1e-3)


@pytest.mark.slow
def test_a_drive_can_be_driven_again_alone() -> None:
    """Neither the tasks beside it nor the car changes what the sensors draw."""
    pytest.importorskip("vehiclemodels")
    together, alone = encounters().drive("bmw_320i", "yield", [0, 1]), encounters().drive("bmw_320i", "yield", [1])
    n = int(alone.trace.n_steps[0])
    assert n == together.trace.n_steps[1]
    np.testing.assert_allclose(together.trace.position_m[: n + 1, 1], alone.trace.position_m[: n + 1, 0], atol=1e-3)
