"""Following: a leader is seen whatever the prediction horizon, a follower does not hold up its leader."""

import pytest
import torch
from composed import compose_config
from games import draw_tasks, drive, meet
from situations import CAR
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.planner.following import predicted_s
from negopipe.planner.situation import Others, Situation
from negopipe.simulation.road import RouteState
from negopipe.simulation.state import EGO, World

PASSED = 20.0
"""s of an ego that has passed the corridor, m."""
NULL = "planner.leader_horizon_s=null"


def built(planner: str, *overrides: str, n_social: int = 2) -> tuple[RunConfig, Game]:
    config = compose_config([f"planner={planner}", f"scenario.n_social={n_social}", *overrides])
    return config, build_game(config)


def test_leaders_have_a_horizon_of_their_own_and_followers_none() -> None:
    _, game = built("frenet")
    road, zero = game.simulator.road, torch.zeros(4, 2)
    s = torch.tensor([[5.0, 5.0], [-5.0, -5.0], [5.0, 5.0], [0.5, -0.5]])
    its_direction = torch.tensor([[1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, -1.0]])
    # ahead, behind, oncoming, beside; the second vehicle drives against the line
    at = torch.where(its_direction == torch.tensor([1.0, -1.0]), s, road.config.corridor_length_m - s)
    other = road.to_world(RouteState(at, zero + 3, zero, *road.route_offset(at, its_direction)), its_direction)
    route = RouteState(*torch.zeros(6, 2))
    direction, horizon = torch.tensor([1.0, -1.0]), torch.tensor([2.0, torch.inf])
    others = Others.of(road, other, direction, torch.ones(4, 2, dtype=torch.bool), CAR)
    seconds = predicted_s(4.0, Situation(route, direction, horizon, horizon, CAR, others))
    assert seconds.tolist() == [[4.0, torch.inf], [0.0, 0.0], [2.0, torch.inf], [4.0, 0.0]]


def finish(planner: str, *overrides: str, s: list[list[float]], speed: list[list[float]], horizon: Tensor) -> World:
    config, game = built(planner, *overrides)
    return drive(game, meet(config, game, s, speed), horizon, config.scenario.episode_steps)[-1]


def queue(planner: str, *overrides: str) -> World:
    """The ego comes first, a leader waits for it, and a follower that predicts nothing comes 8 to 12 m behind."""
    s = [[-9.0, -15.0, -27.0], [-9.0, -16.0, -26.0], [-9.0, -15.0, -23.0]]
    return finish(planner, *overrides, s=s, speed=[[5.0, 5.0, 6.0]] * 3, horizon=torch.tensor([[0.0, 6.0, 0.0]] * 3))


@pytest.mark.parametrize("planner", ["consistent_stops", "reversing"])
def test_who_predicts_nothing_stops_behind_its_leader(planner: str) -> None:
    world = queue(planner)
    assert not world.has_collided.any()
    assert world.has_reached.all()


BRIEF = "scenario.episode_steps=80"


def test_without_the_rule_it_runs_into_its_leader() -> None:
    for world in (queue("frenet", BRIEF), queue("consistent_stops", NULL, BRIEF)):
        assert world.has_collided[:, 1:].all()
        assert not world.has_collided[:, EGO].any()


def close_behind(*overrides: str) -> World:
    """A follower stands 0.3 m behind a leader that stands, nearer than a plan may come; both predict 4 s."""
    start, horizon = [[PASSED, -20.0, -24.8]], torch.tensor([[0.0, 4.0, 4.0]])
    return finish("consistent_stops", *overrides, s=start, speed=[[6.0, 0.0, 0.0]], horizon=horizon)


def test_a_follower_close_behind_does_not_hold_up_its_leader() -> None:
    assert close_behind().has_reached.all()
    held_up = close_behind(NULL)
    assert float(held_up.vehicles.speed[0, 1]) == 0
    assert not held_up.has_reached[0, 1:].any()


def test_one_oncoming_vehicle_is_predicted_as_always() -> None:
    config, game = built("consistent_stops", n_social=1)
    _, without = built("consistent_stops", NULL, n_social=1)
    world, horizon = game.simulator.reset(draw_tasks(config, 16)), torch.tensor([[6.0, 2.0], [0.0, 4.0]]).repeat(8, 1)
    for _ in range(30):
        motion = game.plan(game.perceive(world), horizon)
        again = without.plan(without.perceive(world), horizon)
        assert torch.equal(motion.state.position, again.state.position)
        assert torch.equal(motion.is_full_braking, again.is_full_braking)
        world, _ = game.simulator.step(world, motion.state)
