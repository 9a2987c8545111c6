"""Drivers by rule and whoever is already where it cannot be passed: they wait for it, and do not drive into it."""

from dataclasses import replace
from functools import partial

import pytest
from composed import compose_config
from games import draw_tasks, meet

from negopipe.agents.drivers import cautious
from negopipe.agents.encounter import encounter
from negopipe.agents.route_following import FREE_M, RouteFollowingConfig
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.trace import OUTCOMES
from negopipe.game.game import Game, build_game

BASELINES = "evaluation/baseline=[cautious,direction_first]"
CAR_M = 4.5


@pytest.fixture(scope="module")
def one_sided() -> tuple[RunConfig, Game]:
    """The other's waiting place lies at -10.0 m, the ego's at -10.75 m; at -10.25 m it can just be passed."""
    config = compose_config(["scenario=one_sided", BASELINES, "report.side_by_side=[]"])
    return config, build_game(config)


def gap_m(built: tuple[RunConfig, Game], driver: str, s: list[float], speed: list[float]) -> float:
    """Gap to what the ego brakes for, m; the ego and the other are at `s` (m) at `speed` (m/s)."""
    config, game = built
    perception = game.perceive(meet(config, game, [s], [speed])).of(0)
    rule = config.evaluation.baselines[driver]
    assert isinstance(rule, RouteFollowingConfig)
    return rule.hindrance(game.simulator)(perception, encounter(game.simulator.road, perception)).gap_m.item()


@pytest.mark.parametrize("driver", ["cautious", "direction_first"])
def test_who_rests_on_the_route_is_in_the_way(one_sided: tuple[RunConfig, Game], driver: str) -> None:
    """From the mouth, with another one before its own mouth, 12 m farther."""
    assert gap_m(one_sided, driver, [0.0, -7.7], [5.0, 0.0]) == pytest.approx(12.0 + 7.7 - CAR_M, abs=1e-3)
    assert gap_m(one_sided, driver, [0.0, -7.7], [5.0, 1.0]) == FREE_M  # it may drive out of the way
    assert gap_m(one_sided, driver, [0.0, -10.0], [5.0, 0.0]) == FREE_M


@pytest.mark.parametrize(
    ("ego_m", "ego_mps", "other_m", "waits"),
    [
        (-11.0, 1.0, -9.5, True),
        (-11.0, 1.0, -10.5, False),  # it can be passed
        (-11.0, 4.0, -9.5, False),  # the ego could stop only where nobody can pass it
        (-11.0, 3.0, -9.5, True),
    ],
)
def test_cautious_waits_for_who_is_in_the_passage_while_it_can_still_stop(
    one_sided: tuple[RunConfig, Game], ego_m: float, ego_mps: float, other_m: float, waits: bool
) -> None:
    gap = gap_m(one_sided, "cautious", [ego_m, other_m], [ego_mps, 0.2])  # it would be at its mouth after half a minute
    usual = one_sided[0].evaluation.baselines["cautious"]
    assert isinstance(usual, cautious.Config)
    assert gap == pytest.approx(-10.75 - ego_m + usual.gap_m if waits else FREE_M, abs=1e-3)


def test_who_is_in_the_next_narrow_place_is_not_waited_for() -> None:
    config = compose_config(["scenario=one_sided", "scenario.road.n_corridors=2", BASELINES, "report.side_by_side=[]"])
    built = config, build_game(config)
    far_m = config.scenario.road.corridor_length_m + config.scenario.road.between_corridors_m
    assert gap_m(built, "cautious", [-11.0, -9.5], [1.0, 0.2]) == FREE_M
    assert gap_m(built, "cautious", [-11.0, -9.5 + far_m], [1.0, 0.2]) < FREE_M


@pytest.mark.parametrize(
    ("scenario", "start_m", "style_s"),
    [
        ("one_sided", 12.78, 4.0),
        pytest.param("one_sided", 12.71, 6.0, marks=pytest.mark.slow),
        ("narrow_lane", 13.12, 6.0),
        pytest.param("bent_street", 12.21, 6.0, marks=pytest.mark.slow),
    ],
)
def test_two_that_hesitate_get_through(scenario: str, start_m: float, style_s: float) -> None:
    """Each slows down for the other, who then stands beyond its waiting place, where cautious drove into it."""
    config = compose_config([f"scenario={scenario}", "planner=consistent_stops", BASELINES, "report.side_by_side=[]"])
    game, task = build_game(config), draw_tasks(config, 1)
    start, style = task.start_distance.clone(), task.style_horizon.clone()
    start[:, 1], style[:, 1] = start_m, style_s
    driver = partial(config.evaluation.baselines["cautious"].driver, game)
    same = replace(task, start_distance=start, style_horizon=style)
    trace = drive_episodes(game, driver, same, 1, config.evaluation.reward, ("cautious", "x"))
    assert OUTCOMES[int(trace.outcome[0])] == "success"
