"""Reset, step and events with hand-placed vehicles; a batch equals single worlds."""

import math
from dataclasses import replace

import pytest
import torch
from games import draw_tasks, place

from negopipe.config.root import RunConfig
from negopipe.game.game import Game
from negopipe.simulation.perception import other_columns
from negopipe.simulation.state import VehicleState, World


def placed(ego: tuple[float, float, float], social: tuple[float, float, float]) -> VehicleState:
    """x, y, yaw of both vehicles in one world."""
    pose = torch.tensor([[ego, social]])
    zero = torch.zeros(1, 2)
    return VehicleState(pose[..., :2], pose[..., 2], zero, zero, zero)


@pytest.fixture
def world(config: RunConfig, game: Game) -> World:
    return game.simulator.reset(draw_tasks(config, 1))


def test_reset_places_vehicles_in_their_lanes(config: RunConfig, game: Game) -> None:
    task = draw_tasks(config, 50)
    world = game.simulator.reset(task)
    distance = config.scenario.road.corridor_length_m / 2 + task.start_distance
    torch.testing.assert_close(world.vehicles.position[..., 0], -task.direction * distance)
    lane = torch.full_like(distance, -config.scenario.road.lane_offset_m) * task.direction
    torch.testing.assert_close(world.vehicles.position[..., 1], lane, atol=0.02, rtol=0)
    torch.testing.assert_close(world.vehicles.speed, task.start_speed)
    assert not game.simulator.touches(world).any()
    expected = world.pose_history[:, :1].expand_as(world.pose_history)
    torch.testing.assert_close(world.pose_history, expected)


@pytest.mark.parametrize(
    ("ego", "social", "hits"),
    [
        ((-20.0, -1.75, 0.0), (20.0, 1.75, math.pi), [False, False]),
        ((0.0, 0.0, 0.0), (4.4, 0.0, math.pi), [True, True]),  # nose in nose: 4.5 m long
        ((0.0, 0.0, 0.0), (4.6, 0.0, math.pi), [False, False]),
        ((0.0, 0.75, 0.0), (20.0, 1.75, math.pi), [True, False]),  # in the corridor, 0.7 m free on each side
        ((0.0, 0.65, 0.0), (20.0, 1.75, math.pi), [False, False]),
        ((-20.0, -2.65, 0.0), (20.0, 1.75, math.pi), [True, False]),  # over the kerb at 3.5 m
        ((-20.0, -2.55, 0.0), (20.0, 1.75, math.pi), [False, False]),
        ((-20.0, -2.55, 0.1), (20.0, 1.75, math.pi), [True, False]),  # turned, a corner reaches over it
    ],
)
def test_collisions_by_hand(
    game: Game,
    world: World,
    ego: tuple[float, float, float],
    social: tuple[float, float, float],
    hits: list[bool],
) -> None:
    there = placed(ego, social)
    after, events = game.simulator.step(place(world, there), there)
    assert after.has_collided[0].tolist() == hits
    assert bool(events.is_collision) == any(hits)
    assert bool(events.is_terminated) == any(hits)


def test_success_needs_everyone(config: RunConfig, game: Game, world: World) -> None:
    beyond = config.scenario.road.corridor_length_m / 2 + config.scenario.road.target_distance_m + 0.1
    before = place(world, placed((beyond - 1, -1.75, 0.0), (20.0, 1.75, math.pi)))
    one, events = game.simulator.step(before, placed((beyond, -1.75, 0.0), (20.0, 1.75, math.pi)))
    assert one.has_reached.tolist() == [[True, False]]
    assert not events.is_terminated
    # a vehicle that has arrived stays arrived, wherever it drives then
    before = place(one, placed((beyond - 8, -1.75, 0.0), (1 - beyond, 1.75, math.pi)))
    both, events = game.simulator.step(before, placed((beyond - 8, -1.75, 0.0), (-beyond, 1.75, math.pi)))
    assert both.has_reached.all()
    assert events.is_success
    assert events.is_terminated
    assert not events.is_truncated


def test_time_limit_truncates(config: RunConfig, game: Game, world: World) -> None:
    still = placed((-20.0, -1.75, 0.0), (20.0, 1.75, math.pi))
    late = replace(world, step=torch.tensor([config.scenario.episode_steps - 2]))
    late, events = game.simulator.step(late, still)
    assert not events.is_truncated
    late, events = game.simulator.step(late, still)
    assert events.is_truncated
    assert not events.is_terminated


def test_history_moves_on(game: Game, world: World) -> None:
    there = placed((-19.0, -1.75, 0.0), (19.0, 1.75, math.pi))
    moved, _ = game.simulator.step(world, there)
    torch.testing.assert_close(moved.pose_history[:, 0, :, :2], there.position)
    torch.testing.assert_close(moved.pose_history[:, 1:], world.pose_history[:, :-1])


def switching(world: World, at_s: float, patience_s: float) -> World:
    """The social vehicle drives in style 2 and switches to style 6."""

    def social(value: float) -> torch.Tensor:
        return torch.tensor([[torch.nan, value]])

    times = {"switch_time": social(at_s), "patience": social(patience_s)}
    task = replace(world.task, style_horizon=social(2.0), next_style_horizon=social(6.0), **times)
    return replace(world, task=task)


def styles_of(game: Game, world: World, speeds: list[float]) -> list[float]:
    """Style of the social vehicle at the start and after each step, driven at `speeds`."""
    seen = [float(game.perceive(world).style_horizon[0, 1])]
    for speed in speeds:
        motion = replace(world.vehicles, speed=torch.tensor([[0.0, speed]]))
        world, _ = game.simulator.step(world, motion)
        seen.append(float(game.perceive(world).style_horizon[0, 1]))
    assert game.perceive(world).style_horizon[0, 0].isnan()
    assert not world.has_switched[0, 0]
    return seen


def test_style_switches_at_its_time_and_stays(game: Game, world: World) -> None:
    styles = styles_of(game, switching(world, 1.4, math.inf), [4.0] * 12)
    assert styles == [2.0] * 7 + [6.0] * 6  # in force from the decision at 1.4 s on


@pytest.mark.parametrize(
    ("speeds", "first"),
    [
        ([0.0] * 20, 8),  # rest counts after the first second, so 0.6 s of it are over after 1.6 s
        ([4.0] * 8 + [0.05] * 6, 11),  # slower than 0.1 m/s is rest
        ([4.0] * 8 + [0.0, 0.0, 0.2] + [0.0] * 5, 14),  # a break starts the count anew
        ([4.0] * 8 + [0.15] * 8, None),
        ([4.0] * 8 + [0.0] * 4 + [4.0] * 4, 11),  # once only, it does not switch back
    ],
)
def test_style_switches_out_of_impatience(game: Game, world: World, speeds: list[float], first: int | None) -> None:
    styles = styles_of(game, switching(world, math.inf, 0.6), speeds)
    n_before = len(styles) if first is None else first
    assert styles == [2.0] * n_before + [6.0] * (len(styles) - n_before)


def test_everyone_sees_the_others(three_social_config: RunConfig, three_social: Game) -> None:
    assert other_columns(4).tolist() == [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]
    world = three_social.simulator.reset(draw_tasks(three_social_config, 2))
    seen = three_social.perceive(world)
    torch.testing.assert_close(seen.other.position[:, 2, 0], world.vehicles.position[:, 0])
    torch.testing.assert_close(seen.other.position[:, 2, 2], world.vehicles.position[:, 3])
    assert seen.of(2).other.position.shape == (2, 1, 3, 2)
