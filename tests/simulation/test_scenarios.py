"""Every scenario in conf/scenario composes, builds and starts without a collision."""

import pytest
import torch
from games import draw_tasks

from negopipe import CONF
from negopipe.config import RunConfig
from negopipe.env import Game, build_game
from negopipe.gym_env import compose_config
from negopipe.simulation.perception import perceive
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO

NAMES = sorted(path.stem for path in (CONF / "scenario").glob("*.yaml"))


@pytest.fixture(scope="module", params=NAMES)
def built(request: pytest.FixtureRequest) -> tuple[RunConfig, Game]:
    config = compose_config([f"scenario={request.param}"])
    return config, build_game(config.scenario, config.planner, config.observation)


def test_nobody_starts_in_a_collision(built: tuple[RunConfig, Game]) -> None:
    config, game = built
    sampler = TaskSampler(config.scenario, config.scenario.families, torch.Generator().manual_seed(0))
    world = game.simulator.reset(sampler.draw(64))
    assert not game.simulator.collides(world.vehicles).any()
    torch.testing.assert_close(world.vehicles.speed, world.task.start_speed)
    s = game.simulator.road.progress(world.vehicles.position, world.task.direction)
    torch.testing.assert_close(-s, world.task.start_distance, atol=1e-4, rtol=0)


def test_a_vehicle_on_its_route_touches_nothing(built: tuple[RunConfig, Game]) -> None:
    # alone along the whole road in both directions: the corridor is passable, in a bend too
    config, game = built
    s = torch.linspace(-30.0, game.simulator.road.target_s_m + 5, 200)
    for seat in (0, 1):
        start = torch.full((200, 2), -300.0)  # the other one is far away, beyond the corridor
        start[:, seat] = -s
        task = draw_tasks(config, 200)
        task.start_distance.copy_(start)
        world = game.simulator.reset(task)
        assert not game.simulator.collides(world.vehicles)[:, seat].any()


def test_two_vehicles_do_not_fit_into_the_corridor(built: tuple[RunConfig, Game]) -> None:
    config, _ = built
    assert config.scenario.road.corridor_gap_m < 2 * config.scenario.vehicle.width_m


def test_the_own_lane_is_free_in_the_grid(built: tuple[RunConfig, Game]) -> None:
    config, game = built
    world = game.simulator.reset(draw_tasks(config, 2))
    grid = game.draw(perceive(world).of(EGO))[0, 0].bool()
    o, size = config.observation, config.scenario.vehicle
    first_ahead = o.n_cells - int((o.behind_m + size.length_m / 2) / o.cell_along_m) - 2
    middle = o.n_cells // 2
    assert not grid[first_ahead - 4 : first_ahead, middle - 4 : middle + 4].any()  # 2.4 m ahead of the ego
    assert grid[:, -1].any()  # the kerb to the right


def test_episodes_run(built: tuple[RunConfig, Game]) -> None:
    config, game = built
    world = game.simulator.reset(draw_tasks(config, 4))
    for _ in range(5):
        motion = game.plan(perceive(world), torch.full((4, 2), 4.0))
        world, _ = game.simulator.step(world, motion.state)
    assert torch.isfinite(world.vehicles.position).all()
    assert not world.has_collided.any()
