"""Random decisions by the million: the world stays sound whatever the ego picks.

NEGOPIPE_RANDOM_DECISIONS sets how many; without it, 1,000,000.
"""

import os

import pytest
import torch
from composed import compose_config
from torch import Tensor

from negopipe.game.environment import NegotiationEnv
from negopipe.game.game import build_game, has_compiler
from negopipe.game.reward import RewardConfig
from negopipe.simulation.geometry import Boxes, boxes_from_pose, overlap_depth
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import EGO, World

N_DECISIONS = int(os.environ.get("NEGOPIPE_RANDOM_DECISIONS") or "1000000")
MIXED = ("population=mixed", "planner=reversing", "policy=cnn_inf")
STREETS = (
    "scenario=random_streets",
    "curriculum=streets",
    "scenario.streets.n_training=1",
    "scenario.streets.n_held_out=2048",
)
LEAST_STREETS = 1000
"""Streets that the drives on drawn streets must be on, of 100,000 decisions and more."""
TRAFFIC = (
    *("population=mixed", "planner=traffic", "policy=cnn_inf"),
    *("scenario.n_followers=1", "scenario/kind=[small_car,car,van,bus,cyclist]", "perception.occlusion=true"),
)
WIDTHS = (
    "scenario.road.width_changes=[{start_m:[-50.0,-40.0],length_m:[6.0,15.0],width_m:[5.5,9.0]},"
    "{start_m:[16.0,25.0],length_m:[6.0,15.0],width_m:[5.5,9.0]}]"
)
N_PROCESSES = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT") or "1")
"""Processes of tests, which share the cores."""
N_WORLDS = min(4096, max(1, N_DECISIONS // 128))
N_STEPS = -(-N_DECISIONS // N_WORLDS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        (),
        MIXED,
        (*STREETS, *MIXED),
        (*TRAFFIC, "scenario.n_social=2"),
    ],
    ids=["default", "mixed", "streets", "traffic"],
)
def test_the_world_stays_sound(options: tuple[str, ...]) -> None:
    torch.set_num_threads(max(1, min(4, (os.cpu_count() or 1) // N_PROCESSES)))
    streets = drive_at_random(options, N_WORLDS, N_STEPS, is_compiled=has_compiler())
    assert len(streets) >= (min(LEAST_STREETS, N_WORLDS // 2) if "scenario=random_streets" in options else 1)


def test_a_little_traffic_stays_sound() -> None:
    drive_at_random((*TRAFFIC, "scenario.episode_steps=40"), 24, 45, is_compiled=False)


def test_a_few_streets_of_changing_width_stay_sound() -> None:
    few = ("scenario.streets.n_training=1", "scenario.streets.n_held_out=16", "scenario.episode_steps=40")
    streets = drive_at_random((*STREETS[:2], *few, WIDTHS, *MIXED), 24, 45, is_compiled=False)
    assert len(streets) > 8


def drive_at_random(options: tuple[str, ...], n_worlds: int, n_steps: int, is_compiled: bool) -> set[float]:
    """Numbers of the streets of all drives."""
    config = compose_config(options)
    families = config.scenario.families
    game = build_game(config, is_compiled=is_compiled)
    sampler = TaskSampler(config.scenario, families, torch.Generator().manual_seed(0), game.cast.assign)
    env = NegotiationEnv(game, config.reward, config.policy.horizons_s, sampler, n_worlds)
    actions = torch.Generator().manual_seed(1)
    limits, dt, n_over, met = config.planner.limits, config.scenario.dt_s, 0, set()
    streets: set[float] = set()
    for _ in range(n_steps):
        before = env.world
        reached = env.step(torch.randint(env.n_actions, (n_worlds,), generator=actions))
        now, is_over = env.world, reached.is_terminated | reached.is_truncated
        n_over += int(is_over.sum())
        met |= set(now.task.family.unique().tolist())
        streets |= set(now.task.direction.abs().unique().tolist())
        assert is_finite(now)
        assert float(now.vehicles.speed.min()) >= config.planner.lowest_speed_mps * 1.1
        # whoever goes on has not collided: a world that was recorded as a collision has started again
        assert not touches(game.simulator, now).any()
        expected = eq_3(config.reward, reached.is_collision, reached.is_success)
        assert torch.equal(reached.reward, expected)
        assert torch.equal(reached.is_terminated, reached.is_collision | reached.is_success)
        gained = ((now.vehicles.speed - before.vehicles.speed) / dt)[~is_over]
        # full braking goes on along a path whose metres per metre of road change, and may speed up by as little
        assert float(now.vehicles.speed.max()) <= limits.speed_max_mps * 1.05
        if len(gained):  # nobody goes on where all are out of time at once
            assert float(gained.max()) <= limits.accel_max_mps2 + 0.5
            assert float(gained.min()) >= -limits.full_braking_mps2 - 1.0
    assert n_over > n_worlds // 2
    assert met == set(range(len(families)))
    return streets


def is_finite(world: World) -> bool:
    """No NaN or inf but where the task says so: styles of the ego and of drivers by rule, switches that never come."""
    vehicles = world.vehicles
    fields = (vehicles.position, vehicles.yaw, vehicles.speed, vehicles.accel, vehicles.curvature)
    has_style = ~world.task.style_horizon[:, EGO + 1 :].isnan()
    social = world.style_horizon[:, EGO + 1 :][has_style]
    rest = (world.pose_history, world.speed_history, world.command_queue, social)
    return all(bool(torch.isfinite(field).all()) for field in (*fields, *rest))


def touches(simulator: Simulator, world: World) -> Tensor:
    """[E] bool: footprints overlap one another, a parked car or a kerb by more than a rounding.

    Social vehicles that have collided stay where they are.
    """
    road, direction = simulator.road, world.task.direction
    x, y = world.vehicles.position.unbind(-1)
    boxes = boxes_from_pose(x, y, world.vehicles.yaw, world.task.length - 2e-4, world.task.width - 2e-4)
    own, other = (Boxes(*(field.unsqueeze(axis) for field in boxes)) for axis in (2, 1))  # type: ignore[union-attr]
    is_other = ~torch.eye(x.shape[1], dtype=torch.bool)
    hits_other = ((overlap_depth(own, other) > 0) & is_other).any(-1)
    hits_parked = (overlap_depth(own, road.parked_boxes(direction)) > 0).any(-1)
    return ((road.is_off_road(boxes, direction) | hits_parked | hits_other) & ~world.has_collided).any(-1)


def eq_3(config: RewardConfig, is_collision: Tensor, is_success: Tensor) -> Tensor:
    """[E] float32: of every decision a step, and what ended the episode."""
    return config.step + torch.where(is_collision, config.collision, torch.where(is_success, config.success, 0.0))
