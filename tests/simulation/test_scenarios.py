"""Every scenario in conf/scenario composes, builds and starts without a collision."""

import pytest
import torch
from composed import compose_config
from games import draw_tasks

from negopipe import CONF
from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.simulation.build_road import draw_streets
from negopipe.simulation.geometry import Boxes, boxes_from_pose, overlap_depth
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO, VehicleState

OF_A_MAP = {"lanelet2", "commonroad"}
"""Scenarios that need a file, see test_map_road."""

NAMES = sorted({path.stem for path in (CONF / "scenario").glob("*.yaml")} - OF_A_MAP)


@pytest.fixture(scope="module", params=NAMES)
def built(request: pytest.FixtureRequest) -> tuple[RunConfig, Game]:
    few = ["scenario.streets.n_training=8", "scenario.streets.n_held_out=32"]
    config = compose_config([f"scenario={request.param}", *few])
    return config, build_game(config)


def test_nobody_starts_in_a_collision(built: tuple[RunConfig, Game]) -> None:
    config, game = built
    sampler = TaskSampler(config.scenario, config.scenario.families, torch.Generator().manual_seed(0))
    world = game.simulator.reset(sampler.draw(64))
    assert not game.simulator.touches(world).any()
    torch.testing.assert_close(world.vehicles.speed, world.task.start_speed)
    s = game.simulator.road.progress(world.vehicles.position, world.task.direction)
    torch.testing.assert_close(-s, world.task.start_distance, atol=1e-4, rtol=0)


def ways(road: Road) -> torch.Tensor:
    """[W] directions: both of every street, or of 20 of many streets."""
    step = max(1, road.n_streets // 20)
    return road.ways.unflatten(0, (-1, 2))[::step].flatten()


@pytest.fixture(scope="module")
def on_route(built: tuple[RunConfig, Game]) -> VehicleState:
    """Vehicles all along the road, [S, W] for both ways of some streets, standing on their route."""
    road = built[1].simulator.road
    direction = ways(road)
    s = torch.linspace(-60.0, 80.0, 1401)[:, None].expand(-1, len(direction))
    still = torch.zeros_like(s)
    return road.to_world(RouteState(s, still, still, *road.route_offset(s, direction)), direction)


def test_the_route_keeps_the_planners_clearance(built: tuple[RunConfig, Game], on_route: VehicleState) -> None:
    config, game = built
    size, grown = config.scenario.vehicle, 2 * config.planner.clearance.parked_m
    x, y = on_route.position.unbind(-1)
    boxes = boxes_from_pose(x, y, on_route.yaw, size.length_m + grown, size.width_m + grown)
    road, direction = game.simulator.road, ways(game.simulator.road).expand_as(x)
    assert not road.is_off_road(boxes, direction).any()
    each = Boxes(*(field[..., None] if isinstance(field, torch.Tensor) else field for field in boxes))
    assert not (overlap_depth(each, road.parked_boxes(direction)) > 0).any()


def test_the_route_can_be_driven_at_the_desired_speed(built: tuple[RunConfig, Game], on_route: VehicleState) -> None:
    config, _ = built
    limits, speed = config.planner.limits, config.scenario.desired_speed_mps[1]
    allowed = min(limits.curvature_max_1pm, limits.lateral_accel_max_mps2 / speed**2)
    assert float(on_route.curvature.abs().max()) <= allowed


def test_two_vehicles_do_not_fit_into_the_corridor(built: tuple[RunConfig, Game]) -> None:
    scenario = built[0].scenario
    needed_m = 2 * scenario.vehicle.width_m + 3 * scenario.streets.clearance_m  # beside and between them
    assert max(street.corridor_gap_m for street in draw_streets(scenario)) < needed_m


def test_the_own_lane_is_free_in_the_grid(built: tuple[RunConfig, Game]) -> None:
    config, game = built
    world = game.simulator.reset(draw_tasks(config, 2))
    grid = game.draw(game.perceive(world).of(EGO))[0, 0].bool()
    o, size = config.observation, config.scenario.vehicle
    first_ahead = o.n_cells - int((o.behind_m + size.length_m / 2) / o.cell_along_m) - 2
    middle = o.n_cells // 2
    assert not grid[first_ahead - 4 : first_ahead, middle - 4 : middle + 4].any()  # 2.4 m ahead of the ego
    assert grid[:, -1].any()  # the kerb to the right


def test_episodes_run(built: tuple[RunConfig, Game]) -> None:
    config, game = built
    world = game.simulator.reset(draw_tasks(config, 4))
    for _ in range(5):
        motion = game.plan(game.perceive(world), torch.full((4, 2), 4.0))
        world, _ = game.simulator.step(world, motion.state)
    assert torch.isfinite(world.vehicles.position).all()
    assert not world.has_collided.any()
