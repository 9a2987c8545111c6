"""The planner: limits, horizon, parked cars, full braking; one batched call equals a plain loop."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from games import draw_tasks, place

from negopipe.config.root import RunConfig
from negopipe.game.game import Game
from negopipe.planner.frenet import FrenetPlanner
from negopipe.simulation.geometry import boxes_from_pose, overlap_depth
from negopipe.simulation.perception import Perception
from negopipe.simulation.state import EGO, Motion, World
from negopipe.tensors.tree import map_tensors

HORIZONS = (0.0, 2.0, 4.0, 6.0)


def drive(game: Game, world: World, horizon: torch.Tensor, n_steps: int) -> list[tuple[World, Motion]]:
    rows = []
    for _ in range(n_steps):
        motion = game.plan(game.perceive(world), horizon)
        world, _ = game.simulator.step(world, motion.state)
        rows.append((world, motion))
    return rows


@pytest.fixture(scope="module")
def drives(config: RunConfig, game: Game) -> list[tuple[World, Motion]]:
    """80 decisions of 32 worlds with every pair of horizons."""
    world = game.simulator.reset(draw_tasks(config, 32))
    pairs = torch.cartesian_prod(torch.tensor(HORIZONS), torch.tensor(HORIZONS)).repeat(2, 1)
    return drive(game, world, pairs, 80)


def test_at_least_150_combinations(game: Game) -> None:
    assert game.planner.n_combinations >= 150


def test_executed_motion_keeps_the_limits(config: RunConfig, game: Game, drives: list[tuple[World, Motion]]) -> None:
    limits, dt = config.planner.limits, config.scenario.dt_s
    before = game.simulator.reset(draw_tasks(config, 32)).vehicles
    for world, motion in drives:
        now, is_planned = world.vehicles, ~motion.is_full_braking
        assert (now.speed >= 0).all()
        assert (now.speed <= limits.speed_max_mps * 1.1).all()  # 1.1: along the path, not along the road
        assert (now.curvature.abs()[is_planned] <= limits.curvature_max_1pm + 1e-3).all()
        gained = (now.speed - before.speed)[is_planned & ~world.has_collided]
        assert (gained <= (limits.accel_max_mps2 + 0.5) * dt).all()
        assert (now.speed - before.speed >= -(limits.full_braking_mps2 + 0.8) * dt).all()
        moved = (now.position - before.position).norm(dim=-1)
        mean_speed = (now.speed + before.speed) / 2
        drives_on = ~world.has_collided  # who collides stops where that happens, within the step
        torch.testing.assert_close(moved[drives_on], (mean_speed * dt)[drives_on], atol=0.06, rtol=0.03)
        before = now


def test_nobody_slides_sideways(drives: list[tuple[World, Motion]]) -> None:
    for (earlier, _), (later, _) in pairwise(drives):
        step = later.vehicles.position - earlier.vehicles.position
        yaw = (earlier.vehicles.yaw + later.vehicles.yaw) / 2
        wraps = (later.vehicles.yaw - earlier.vehicles.yaw).abs() > 3
        across = -torch.sin(yaw) * step[..., 0] + torch.cos(yaw) * step[..., 1]
        assert float(across[~wraps].abs().max()) < 0.03


def test_nobody_hits_a_parked_car_or_the_kerb(game: Game, drives: list[tuple[World, Motion]]) -> None:
    parked = game.simulator.road.parked_boxes()
    for world, _ in drives:
        x, y = world.vehicles.position.unbind(-1)
        own = boxes_from_pose(x[..., None], y[..., None], world.vehicles.yaw[..., None], 4.5, 1.8)
        assert float(overlap_depth(own, parked).max()) <= 0


def test_alone_a_vehicle_reaches_its_speed_and_target(config: RunConfig, game: Game) -> None:
    world = game.simulator.reset(draw_tasks(config, 1))
    rows = drive(game, world, torch.zeros(1, 2), 60)
    world, _ = rows[-1]
    assert world.has_reached.all()
    assert float(world.vehicles.speed[0, EGO]) == pytest.approx(6.0, abs=0.1)
    assert not any(motion.is_full_braking.any() for _, motion in rows)


def stand_before(config: RunConfig, game: Game, gap_m: float, speed: float) -> Perception:
    """The ego in the corridor at `speed`, `gap_m` from nose to nose with a vehicle that stands before it."""
    world = game.simulator.reset(draw_tasks(config, 1))
    vehicles = world.vehicles
    position = torch.tensor([[[-5.5, 0.0], [-5.5 + 4.5 + gap_m, 0.0]]])
    placed = replace(vehicles, position=position, speed=torch.tensor([[speed, 0.0]]))
    return game.perceive(place(world, placed))


@pytest.mark.parametrize(("horizon", "stops"), [(0.0, False), (2.0, True), (6.0, True)])
def test_zero_horizon_ignores_what_stands_in_front(config: RunConfig, game: Game, horizon: float, stops: bool) -> None:
    seen = stand_before(config, game, gap_m=3.5, speed=3.0)
    motion = game.plan(seen, torch.full((1, 2), horizon))
    assert (float(motion.state.accel[0, EGO]) < -0.5) == stops


def test_conflict_beyond_the_horizon_does_not_count(config: RunConfig, game: Game) -> None:
    # 14 m to a standing vehicle at 5 m/s: met after 2.8 s, so 2 s of prediction do not see it and 4 s do
    seen = stand_before(config, game, gap_m=14.0, speed=5.0)
    free, short, long = (game.plan(seen, torch.full((1, 2), h)).state.speed[0, EGO] for h in (0.0, 2.0, 4.0))
    assert float(short) == float(free)
    assert float(long) < float(free)


def test_full_braking_where_no_plan_exists(config: RunConfig, game: Game) -> None:
    seen = stand_before(config, game, gap_m=1.0, speed=5.0)
    motion = game.plan(seen, torch.full((1, 2), 2.0))
    dt, decel = config.scenario.dt_s, config.planner.limits.full_braking_mps2
    assert motion.is_full_braking[0, EGO]
    assert float(motion.state.speed[0, EGO]) == pytest.approx(5.0 - decel * dt)
    travelled = float(motion.state.position[0, EGO, 0] - seen.own.position[0, EGO, 0])
    assert travelled == pytest.approx(5.0 * dt - decel * dt**2 / 2, rel=1e-4)


def test_waiting_vehicle_pulls_aside_or_back_enough(config: RunConfig, game: Game) -> None:
    # the scripted yield case: the pushy one comes first, the long horizon waits, and both arrive
    task = draw_tasks(config, 6)
    distance = task.start_distance.clone()
    distance[:, 1] = torch.linspace(11.99, 14.02, 6)
    world = game.simulator.reset(replace(task, start_distance=distance))
    horizon = torch.tensor([[6.0, 2.0]]).expand(6, 2)
    rows = drive(game, world, horizon, config.scenario.episode_steps)
    final = rows[-1][0]
    assert final.has_reached.all()
    assert not final.has_collided.any()
    first_to_leave = torch.stack([world.has_reached for world, _ in rows]).int().argmax(0)
    assert (first_to_leave[:, 1] < first_to_leave[:, EGO]).all()


def test_batch_equals_single_worlds(config: RunConfig, game: Game) -> None:
    world = game.simulator.reset(draw_tasks(config, 16))
    pairs = torch.cartesian_prod(torch.tensor(HORIZONS), torch.tensor(HORIZONS))
    for _ in range(25):
        together = game.plan(game.perceive(world), pairs)
        for i in range(0, 16, 5):
            alone = map_tensors(lambda f, i=i: f[i : i + 1], world)
            motion = game.plan(game.perceive(alone), pairs[i : i + 1])
            row = map_tensors(lambda f, i=i: f[i : i + 1], together)
            map_tensors(lambda a, b: torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4) or a, motion, row)
        world, _ = game.simulator.step(world, together.state)


def test_any_number_of_others(three_social_config: RunConfig, three_social: Game) -> None:
    world = three_social.simulator.reset(draw_tasks(three_social_config, 4))
    rows = drive(three_social, world, torch.full((4, 4), 6.0), 20)
    motion = rows[-1][1]
    assert motion.state.position.shape == (4, 4, 2)
    assert torch.isfinite(motion.state.position).all()
    # the queue keeps its distance: who drives behind predicts the one in front
    s = three_social.simulator.road.progress(rows[-1][0].vehicles.position, world.task.direction)
    assert (s[:, 1] - s[:, 2] > 4.5).all()


@pytest.mark.parametrize(
    "change",
    ["cost.speed", "clearance.ahead_m", "clearance.beside_m", "clearance.beside_s", "limits.accel_max_mps2"],
)
def test_options_act(config: RunConfig, game: Game, change: str) -> None:
    part, key = change.split(".")
    section = getattr(config.planner, part)
    changed = replace(config.planner, **{part: replace(section, **{key: getattr(section, key) * 3 + 0.5})})
    scenario = config.scenario
    other = FrenetPlanner(changed, game.simulator.road, scenario.sizes, scenario.dt_s)
    world = game.simulator.reset(draw_tasks(config, 8))
    horizon = torch.tensor([[6.0, 2.0]]).expand(8, 2)
    differs = False
    for _ in range(40):
        motion = game.plan(game.perceive(world), horizon)
        again = other.plan(game.perceive(world), horizon)
        differs = differs or not torch.equal(motion.state.position, again.state.position)
        world, _ = game.simulator.step(world, motion.state)
    assert differs
