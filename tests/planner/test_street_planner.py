"""The planner on its own plans as the game's does; its options are Hydra's; neither Hydra nor MLflow is needed."""

import math
import subprocess
import sys
from functools import cache

import pytest
import torch
from composed import compose_config

from negopipe.errors import UserError
from negopipe.game.game import build_game
from negopipe.planner.options import planner_option, scenario_option
from negopipe.planner.street_planner import StreetPlanner
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import VehicleState

EGO, OTHER = [-16.0, -1.75, 0.0, 4.8], [18.0, 1.75, math.pi, 5.0]
NOBODY = [math.nan] * 4


def rows(state: VehicleState) -> torch.Tensor:
    """[..., 4]: x, y, yaw, speed."""
    return torch.cat([state.position, state.yaw[..., None], state.speed[..., None]], dim=-1)


@cache
def narrow_lane() -> StreetPlanner:
    return StreetPlanner.of("narrow_lane", "frenet")


@pytest.mark.parametrize("name", ["frenet", "consistent_stops", "reversing", "traffic"])
def test_planner_options_are_those_of_hydra(name: str) -> None:
    assert planner_option(name) == compose_config([f"planner={name}"]).planner


@pytest.mark.parametrize("name", ["narrow_lane", "one_sided"])
def test_scenario_options_are_those_of_hydra(name: str) -> None:
    assert scenario_option(name) == compose_config([f"scenario={name}"]).scenario
    changed = scenario_option(name, {"road": {"target_distance_m": 9.0}})
    assert changed == compose_config([f"scenario={name}", "scenario.road.target_distance_m=9.0"]).scenario


@pytest.mark.parametrize(
    ("scenario", "planner", "road", "said"),
    [
        ("moon", "frenet", None, r"scenario must be one of .*narrow_lane.*, got moon"),
        (
            "narrow_lane",
            "a_star",
            None,
            r"planner must be one of consistent_stops, frenet, reversing, traffic, got a_star",
        ),
        ("narrow_lane", "frenet", {"gap_m": 3.0}, r"scenario\.road\.gap_m: Unexpected keyword argument, got 3\.0"),
        ("narrow_lane", "frenet", {"width_m": -1.0}, r"scenario\.road\.width_m.*greater than 0, got -1\.0"),
    ],
)
def test_what_is_wrong_is_named(scenario: str, planner: str, road: dict[str, float] | None, said: str) -> None:
    with pytest.raises(UserError, match=said):
        StreetPlanner.of(scenario, planner, road)


@pytest.mark.parametrize("planner", ["frenet", "reversing"])
def test_it_plans_as_the_game_does(planner: str) -> None:
    config = compose_config([f"planner={planner}", "scenario.start_speed_mps=[2.0,6.0]"])
    game, random = build_game(config), torch.Generator().manual_seed(3)
    tasks = TaskSampler(config.scenario, config.evaluated_families, random, game.cast.assign).draw(16)
    perception = game.perceive(game.simulator.reset(tasks))
    horizon = torch.tensor([0.0, 2.0, 4.0, 6.0]).repeat(4)[:, None].expand(16, 2)
    motion = game.plan(perception, horizon)
    alone = StreetPlanner(config.scenario, config.planner)
    for agent in (0, 1):
        own, other = (rows(state)[:, agent] for state in (perception.own, perception.other))
        plans = alone.plan(own, other, horizon[:, agent], 6.0)
        for field in ("position", "yaw", "speed", "accel", "curvature"):
            expected = getattr(motion.state, field)[:, agent]
            torch.testing.assert_close(getattr(plans.states, field)[:, 0], expected, rtol=0, atol=1e-5)
        assert torch.equal(plans.is_full_braking, motion.is_full_braking[:, agent])
        assert plans.states.speed.shape == (16, len(alone.times))


def test_one_plan_is_that_of_many() -> None:
    many = narrow_lane().plan([EGO] * 3, [[OTHER]] * 3, [0.0, 4.0, 6.0], [6.0, 5.0, 6.0])
    one = narrow_lane().plan([EGO], [[OTHER]], 4.0, 5.0)
    torch.testing.assert_close(one.states.position[0], many.states.position[1], rtol=0, atol=1e-5)
    assert one.states.position.shape == (1, 30, 2)
    assert one.is_full_braking.shape == (1,)
    assert many.states.position[0, -1, 0] > many.states.position[2, -1, 0] + 5  # a long horizon waits


def test_nobody_is_a_row_of_nan_or_none_at_all() -> None:
    alone = narrow_lane().plan([EGO], None, 6.0, 6.0).states.position
    assert torch.equal(alone, narrow_lane().plan([EGO], [[NOBODY]], 6.0, 6.0).states.position)
    among = narrow_lane().plan([EGO], [[NOBODY, OTHER]], 6.0, 6.0).states.position
    assert torch.equal(among, narrow_lane().plan([EGO], [[OTHER, NOBODY]], 6.0, 6.0).states.position)
    assert (alone - among).abs().max() > 1
    assert torch.equal(among, narrow_lane().plan([[*EGO, 0.0, 0.0]], [[OTHER]], 6.0, 6.0).states.position)


def test_the_yaw_says_which_way_a_vehicle_drives() -> None:
    back = narrow_lane().plan([[16.0, 1.75, math.pi, 4.8]], [[[-18.0, -1.75, 0.0, 5.0]]], 6.0, 6.0).states
    there = narrow_lane().plan([EGO], [[OTHER]], 6.0, 6.0).states
    torch.testing.assert_close(back.position, -there.position, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("vehicles", "others", "said"),
    [
        ([EGO[:3]], None, r"vehicles must have the shape \[N, 4\] or \[N, 6\], got \[1, 3\]"),
        (EGO, None, r"vehicles must have the shape"),
        ([EGO], [OTHER], r"others must have the shape \[1, O, 4\], got \[1, 4\]"),
        ([EGO, EGO], [[OTHER]], r"others must have the shape \[2, O, 4\], got \[1, 1, 4\]"),
    ],
)
def test_a_wrong_shape_is_named(vehicles: list, others: list | None, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        narrow_lane().plan(vehicles, others, 6.0, 6.0)


def test_neither_hydra_nor_mlflow_is_imported() -> None:
    code = (
        "import sys; from negopipe.planner.street_planner import StreetPlanner;"
        "StreetPlanner.of('narrow_lane', 'frenet');"
        "print([name for name in ('hydra', 'mlflow', 'pandas', 'gymnasium') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
def test_compiled_plans_are_the_same() -> None:
    compiled = StreetPlanner.of("narrow_lane", "frenet", is_compiled=True)
    for n in (1, 70):
        given = [EGO] * n, [[OTHER]] * n, 6.0, 6.0
        expected = narrow_lane().plan(*given).states.position
        torch.testing.assert_close(compiled.plan(*given).states.position, expected, rtol=0, atol=1e-4)
