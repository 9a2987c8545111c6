"""Grids on drawn streets against a slow rasteriser of polygons (shapely), cell by cell and with kerbs of its own."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from composed import compose_config

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.simulation.build_road import draw_streets
from negopipe.simulation.geometry import Boxes, boxes_from_pose, rim
from negopipe.simulation.off_road import SAGITTA_M
from negopipe.simulation.road_config import StreetConfig
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO, World
from negopipe.tensors.tree import map_tensors

shapely = pytest.importorskip("shapely")

STEP_M, REACH_M = 0.1, 250.0
KERB_M = SAGITTA_M + 0.005
"""Distance from a kerb within which a cell may differ, m: the edges of the strips that stand for the area beyond a
kerb are straight, and 5 mm are for roundings and the chords between knots. The narrowest cell is 0.15 m wide."""
BOX_M = 1e-3
"""Distance from a vehicle's side within which a cell may differ, m: a rounding of coordinates of 100 m in float32."""

DRAWN = ("scenario=random_streets", "scenario.streets.n_training=1", "scenario.streets.n_held_out=24")
WIDTHS = (
    "scenario.road.width_changes=[{start_m:[-50.0,-40.0],length_m:[6.0,15.0],width_m:[5.5,8.5]},"
    "{start_m:[16.0,25.0],length_m:[6.0,15.0],width_m:[5.5,8.5]}]"
)

STREETS = {
    "random_streets": (24, DRAWN),
    "changing_width": (24, (*DRAWN, WIDTHS)),
    "s_curve": (2, ("scenario=s_curve",)),
}


@pytest.mark.parametrize("name", STREETS)
def test_every_cell_is_as_the_polygons_say(name: str) -> None:
    n, options = STREETS[name]
    config = compose_config(list(options))
    game, streets = build_game(config), draw_streets(config.scenario)
    world = driven(config, game, n)
    grids = game.see(world).bool().numpy()
    frames = (0, config.observation.n_frames - 1)
    n_near = n_cells = 0
    for e in range(n):
        number = int(world.task.direction[e, EGO].abs())
        road = road_polygon(streets[number - 1])
        for frame in frames:
            bodies = shapely.polygons(outlines(game, world, e, frame * config.observation.frame_stride(0.2)))
            x, y = centres(config, world, e)
            expected = ~shapely.contains_xy(road, x, y)
            for body in bodies:
                expected |= shapely.contains_xy(body, x, y)
            wrong = grids[e, frame] != expected
            places = shapely.points(x[wrong], y[wrong])
            is_near = shapely.distance(road.exterior, places) < KERB_M
            for body in bodies:
                is_near |= shapely.distance(body.exterior, places) < BOX_M
            assert is_near.all()
            n_near, n_cells = n_near + len(places), n_cells + wrong.size
    assert n_near < n_cells / 500


def driven(config: RunConfig, game: Game, n: int) -> World:
    """Worlds on `n` streets in which everybody has driven for 2 s."""
    random = torch.Generator().manual_seed(0)
    families, numbers = {"mixture": config.scenario.families["mixture"]}, config.scenario.held_out_streets
    tasks = [TaskSampler(config.scenario, families, random, None, range(i, i + 1)).draw(1) for i in numbers][:n]
    tasks += tasks * (n - len(tasks))
    world = game.simulator.reset(map_tensors(lambda *fields: torch.cat(fields), *tasks))
    for _ in range(10):
        motion = game.plan(game.perceive(world), torch.tensor([[2.0, 6.0]]).expand(n, 2))
        world, _ = game.simulator.step(world, motion.state)
    return world


def road_polygon(street: StreetConfig) -> Any:
    """Area between the kerbs, from the street's config by quadrature."""
    sigma = STEP_M * np.arange(-round(REACH_M / STEP_M), round(REACH_M / STEP_M) + 1)
    heading = np.zeros_like(sigma)
    for bend in street.bends:
        t = np.clip((sigma - bend.start_m) / bend.length_m, 0, 1)
        heading += math.radians(bend.angle_deg) * t**3 * (10 - 15 * t + 6 * t**2)
    middle = len(sigma) // 2
    heading -= heading[middle]
    slopes = (np.cos(heading), np.sin(heading))
    x, y = (np.concatenate([[0.0], np.cumsum(STEP_M * (slope[1:] + slope[:-1]) / 2)]) for slope in slopes)
    x, y, half = x - x[middle], y - y[middle], half_width(street, sigma)
    left = np.stack([x - half * np.sin(heading), y + half * np.cos(heading)], -1)
    right = np.stack([x + half * np.sin(heading), y - half * np.cos(heading)], -1)
    return shapely.Polygon(np.concatenate([left, right[::-1]]))


def half_width(street: StreetConfig, sigma: np.ndarray) -> np.ndarray:
    """[K] m: distance of the kerbs from the line, straight between the knots of the road's tables."""
    knots = np.arange(-REACH_M, REACH_M + 0.25, 0.5)
    width, before = np.full_like(knots, street.width_m), street.width_m
    for change in street.width_changes:
        t = np.clip((knots - change.start_m) / change.length_m, 0, 1)
        width, before = width + (change.width_m - before) * t**3 * (10 - 15 * t + 6 * t**2), change.width_m
    return np.interp(sigma, knots, width) / 2


def outlines(game: Game, world: World, e: int, steps_ago: int) -> np.ndarray:
    """[N, 4, 2]: corners of the parked cars and of all vehicles of a world, as they were some steps ago."""
    road = game.simulator.road
    parked = road.parked_boxes(world.task.direction[e, EGO])
    x, y, yaw = world.pose_history[e, steps_ago].unbind(-1)
    moving = boxes_from_pose(x, y, yaw, world.task.length[e], world.task.width[e])
    return np.concatenate([corners(parked), corners(moving)])


def corners(boxes: Boxes) -> np.ndarray:
    """[N, 4, 2], in the order of the rim."""
    return torch.stack([torch.stack(rim(boxes), -1)[i] for i in (0, 2, 5, 3)], dim=1).double().numpy()


def centres(config: RunConfig, world: World, e: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y [H, W] of the cells' centres, m, world frame."""
    o = config.observation
    rows, columns = np.mgrid[: o.n_cells, : o.n_cells]
    u = (o.n_cells - rows - 0.5) * o.cell_along_m - o.behind_m
    v = (o.n_cells / 2 - columns - 0.5) * o.cell_across_m
    x, y, yaw = world.pose_history[e, 0, EGO].double().tolist()
    return x + u * math.cos(yaw) - v * math.sin(yaw), y + u * math.sin(yaw) + v * math.cos(yaw)
