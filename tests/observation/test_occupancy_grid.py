"""Grids by hand, and against a plain loop over cells."""

import math
from dataclasses import replace

import pytest
import torch
from games import draw_tasks

from negopipe.config.root import RunConfig
from negopipe.game.game import Game
from negopipe.observation.occupancy_grid import OccupancyGrid
from negopipe.simulation.state import EGO, World


def some_worlds(config: RunConfig, game: Game, n_steps: int) -> World:
    world = game.simulator.reset(draw_tasks(config, 3))
    for _ in range(n_steps):
        motion = game.plan(game.perceive(world), torch.tensor([[2.0, 6.0]]).expand(3, 2))
        world, _ = game.simulator.step(world, motion.state)
    return world


def is_occupied(game: Game, world: World, e: int, steps_ago: int, x: float, y: float) -> bool:
    road = game.simulator.road
    if abs(y) >= road.config.width_m / 2:
        return True
    boxes = [tuple(car) for car in road.parked_cars.tolist()]
    boxes += [(*pose, 4.5, 1.8) for pose in world.pose_history[e, steps_ago].tolist()]
    for bx, by, yaw, length, width in boxes:
        u = (x - bx) * math.cos(yaw) + (y - by) * math.sin(yaw)
        v = (y - by) * math.cos(yaw) - (x - bx) * math.sin(yaw)
        if abs(u) <= length / 2 and abs(v) <= width / 2:
            return True
    return False


@pytest.mark.parametrize("n_steps", [0, 30])
def test_agrees_with_a_plain_loop(config: RunConfig, game: Game, n_steps: int) -> None:
    world = some_worlds(config, game, n_steps)
    grids = game.draw(game.perceive(world).of(EGO))
    o, stride = config.observation, config.observation.frame_stride(config.scenario.dt_s)
    n_wrong = n_cells = 0
    for e in range(2):
        x0, y0, yaw0 = world.pose_history[e, 0, EGO].tolist()
        for frame in (0, o.n_frames - 1):
            for row in range(0, o.n_cells, 3):
                for column in range(o.n_cells):
                    u = (o.n_cells - row - 0.5) * o.cell_along_m - o.behind_m
                    v = (o.n_cells / 2 - column - 0.5) * o.cell_across_m
                    x = x0 + u * math.cos(yaw0) - v * math.sin(yaw0)
                    y = y0 + u * math.sin(yaw0) + v * math.cos(yaw0)
                    expected = is_occupied(game, world, e, frame * stride, x, y)
                    n_wrong += expected != bool(grids[e, frame, row, column])
                    n_cells += 1
    assert n_wrong <= n_cells // 1000  # a cell centre may lie on an edge to within rounding


def test_shape_and_values(config: RunConfig, game: Game) -> None:
    grids = game.draw(game.perceive(some_worlds(config, game, 5)).of(EGO))
    assert grids.shape == (3, 4, 84, 84)
    assert grids.dtype == torch.uint8
    assert set(grids.unique().tolist()) == {0, 1}


def test_before_the_start_the_first_state_is_repeated(config: RunConfig, game: Game) -> None:
    grids = game.draw(game.perceive(some_worlds(config, game, 0)).of(EGO))
    assert (grids == grids[:, :1]).all()


def test_social_vehicle_is_seen_from_the_start(config: RunConfig, game: Game) -> None:
    world = some_worlds(config, game, 0)
    far = world.pose_history.clone()
    far[:, :, 1, 0] = 1000.0
    with_other = game.draw(game.perceive(world).of(EGO))
    without = game.draw(game.perceive(replace(world, pose_history=far)).of(EGO))
    assert ((with_other != without).sum((-2, -1)) > 20).all()


def test_grid_reaches_45_m_ahead_and_5_m_behind(config: RunConfig) -> None:
    o = config.observation
    assert o.behind_m >= 5
    assert o.n_cells * o.cell_along_m - o.behind_m >= 45


def test_every_vehicle_is_drawn(three_social_config: RunConfig, three_social: Game) -> None:
    world = three_social.simulator.reset(draw_tasks(three_social_config, 1))
    history = world.pose_history.clone()
    history[:, :, 1:, 0] = torch.tensor([0.0, 8.0, 14.0])
    history[:, :, 1:, 1] = 1.75
    three = three_social.draw(three_social.perceive(replace(world, pose_history=history)).of(EGO))
    history[:, :, 1:, 0] = 1000.0
    none = three_social.draw(three_social.perceive(replace(world, pose_history=history)).of(EGO))
    assert int((three != none)[0, 0].sum()) > 150


@pytest.mark.parametrize("fewer", [2, 54])
def test_a_smaller_grid_is_the_middle_of_a_larger_one(config: RunConfig, game: Game, fewer: int) -> None:
    perception = game.perceive(some_worlds(config, game, 10)).of(EGO)
    scenario, n_cells = config.scenario, config.observation.n_cells - fewer
    smaller = OccupancyGrid(
        replace(config.observation, n_cells=n_cells), game.simulator.road, scenario.sizes, scenario.dt_s
    )
    middle = slice(fewer // 2, fewer // 2 + n_cells)
    assert (smaller.draw(perception) == game.draw(perception)[..., fewer:, middle]).all()


@pytest.mark.parametrize(("key", "value"), [("cell_along_m", 0.7), ("cell_across_m", 0.2), ("behind_m", 10.0)])
def test_options_act(config: RunConfig, game: Game, key: str, value: float) -> None:
    world = some_worlds(config, game, 10)
    changed = replace(config.observation, **{key: value})
    scenario = config.scenario
    other = OccupancyGrid(changed, game.simulator.road, scenario.sizes, scenario.dt_s)
    assert (other.draw(game.perceive(world).of(EGO)) != game.draw(game.perceive(world).of(EGO))).any()


def test_frames_and_interval_act(config: RunConfig, game: Game) -> None:
    world = some_worlds(config, game, 20)
    scenario = config.scenario
    fewer = replace(config.observation, n_frames=2, frame_interval_s=2.0)
    grids = OccupancyGrid(fewer, game.simulator.road, scenario.sizes, scenario.dt_s).draw(game.perceive(world).of(EGO))
    full = game.draw(game.perceive(world).of(EGO))
    assert grids.shape[1] == 2
    assert (grids == full[:, ::2]).all()
