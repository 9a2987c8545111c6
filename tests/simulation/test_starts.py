"""Tasks that start in a collision are refused by name; those that can be driven are not."""

import re
from dataclasses import replace

import pytest
import torch
from composed import compose_config

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.game.game import build_game
from negopipe.simulation.scenario import FamilyConfig, ScenarioConfig, TaskSampler
from negopipe.simulation.starts import check_starts

PUSH = "scenario.families.push.start_distance_m"
STEEP = ("scenario.road.swerve_length_m=2.0", "evaluation.settings=[push]", "evaluation.leading_setting=push")
WIDE = ("scenario.road.corridor_gap_m=5.0", "scenario.road.parked_sides=left")
SHORT = ("scenario.road.corridor_length_m=3.6", "scenario.road.n_parked_per_side=1")

LOST = [
    (
        ("scenario.n_social=3", "scenario.social_spacing_m=2"),
        "scenario.social_spacing_m must keep vehicles of scenario.vehicle.length_m = 4.5 apart, got 2.0",
    ),
    (
        ("scenario.vehicle.width_m=3.3",),
        "scenario.vehicle.width_m must be at most scenario.road.corridor_gap_m = 3.2, got 3.3",
    ),
    (
        ("scenario.vehicle.width_m=3.6", *WIDE),
        "scenario.vehicle.width_m must be at most scenario.road.width_m - 2 lane_offset_m = 3.5, the width of a lane, ",
    ),
    (
        (*STEEP, f"{PUSH}=[1.5,20.0]"),
        f"{PUSH} must keep clear of kerbs and parked cars, got [1.5, 20.0]: at 1.5 m a vehicle touches one, at 2.25 m ",
    ),
    (
        (*STEEP, "scenario.ego_start_distance_m=[2.0,2.0]"),
        "scenario.ego_start_distance_m must keep clear of kerbs and parked cars, got [2.0, 2.0]: at 2 m a vehicle ",
    ),
    (
        (*STEEP, "curriculum.starts.ego_start_distance_m=[2.0,3.0]"),
        "curriculum.starts.ego_start_distance_m must keep clear of kerbs and parked cars, got [2.0, 3.0]: at 2 m ",
    ),
    (
        (*STEEP, "curriculum=three_stages", "curriculum.stages.1.families.yield.start_distance_m=[1.5,13.0]"),
        "curriculum.stages.1.families.yield.start_distance_m must keep clear of kerbs and parked cars, got [1.5, 13",
    ),
    (
        (*SHORT, f"{PUSH}=[0.1,0.1]", "scenario.ego_start_distance_m=[0.1,0.1]"),
        f"{PUSH} and scenario.ego_start_distance_m must keep the vehicles apart, got 0.1 and 0.1 across ",
    ),
]


@pytest.mark.parametrize(("overrides", "line"), LOST, ids=lambda value: " ".join(value) if type(value) is tuple else "")
def test_a_task_that_is_lost_is_refused_by_name(overrides: tuple[str, ...], line: str) -> None:
    with pytest.raises(UserError, match=f"^{re.escape(line)}"):
        compose_config(overrides)


@pytest.mark.parametrize(
    "overrides",
    [
        ("scenario.n_social=3", "scenario.social_spacing_m=4.5"),
        ("scenario.vehicle.width_m=3.2",),
        (f"{PUSH}=[0.01,20.0]",),
        (f"{PUSH}=[20.0,1000000.0]",),
        (*STEEP, f"{PUSH}=[1.5,20.0]", "scenario.families.push.gaps_m=[[1.5,5.0]]", "stages=[evaluate]"),
        (*STEEP, "curriculum.starts.ego_start_distance_m=[2.0,2.0]", "stages=[evaluate]"),
        (*STEEP, "scenario.families.mixture.start_distance_m=[2.0,2.0]"),
    ],
    ids=" ".join,
)
def test_what_can_be_driven_is_not(overrides: tuple[str, ...]) -> None:
    compose_config(overrides)


@pytest.mark.parametrize(
    "scenario", ["narrow_lane", "bent_street", pytest.param("s_curve", marks=pytest.mark.slow), "one_sided"]
)
@pytest.mark.parametrize("swerve_m", [1.0, 2.0, 4.0, 12.0])
def test_the_simulator_agrees(config: RunConfig, scenario: str, swerve_m: float) -> None:
    """At every distance, on every road, with two social vehicles."""
    options = (f"scenario={scenario}", f"scenario.road.swerve_length_m={swerve_m}", "scenario.n_social=2")
    composed = compose_config((*options, "scenario.social_spacing_m=5.0")).scenario
    simulator = build_game(replace(config, scenario=composed)).simulator
    for start_m in (0.01, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 9.0):
        family = replace(composed.families["push"], start_distance_m=(start_m, start_m))
        task = TaskSampler(composed, {"push": family}, torch.Generator()).draw(1)
        is_lost = bool(simulator.touches(simulator.reset(task)).any())
        assert is_refused(composed, family) == is_lost, start_m


def is_refused(scenario: ScenarioConfig, family: FamilyConfig) -> bool:
    return any(check_starts(scenario, {"push": family}, "ego"))
