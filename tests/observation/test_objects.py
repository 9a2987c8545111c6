"""The description of objects by hand, from both seats, with others that are not seen, and every option's effect."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from composed import compose_config
from games import draw_tasks, place
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.observation.objects import OWN, PER_OTHER, Objects, ObjectsConfig
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import EGO, Task, World
from negopipe.simulation.waiting_place import Passage
from negopipe.tensors.tree import map_tensors

OBJECTS = ("observation=objects", "policy=objects")
SPEED, ACCEL, DESIRED, TO_MOUTH, TO_END, HORIZON, REST = 0, 1, 2, 6, 7, slice(11, 14), 14
"""Some of the agent's numbers."""
KNOWN, ONCOMING, UNSEEN, APART, OTHER_SPEED = 0, 1, 2, 6, 11
"""Some of another's numbers."""


@pytest.fixture(scope="module")
def objects_config() -> RunConfig:
    return compose_config(OBJECTS)


@pytest.fixture(scope="module")
def objects_game(objects_config: RunConfig) -> Game:
    return build_game(objects_config)


def observation(game: Game, config: ObjectsConfig) -> Objects:
    simulator: Simulator = game.simulator
    scenario = simulator.scenario
    return Objects(config, Passage.of(simulator.collisions, scenario.sizes), scenario.dt_s)


def objects_of(config: RunConfig) -> ObjectsConfig:
    assert isinstance(config.observation, ObjectsConfig)
    return config.observation


def driven(game: Game, tasks: Task, n_steps: int, horizon: tuple[float, ...] = (2.0, 4.0)) -> World:
    world = game.simulator.reset(tasks)
    for _ in range(n_steps):
        world = game.drive(world, torch.tensor([horizon]).expand(len(tasks), -1)).world
    return world


def blocks(config: RunConfig, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return objects_of(config).layout.split(rows)


def mirrored(task: Task) -> Task:
    """The task in which the two vehicles have changed places; the narrow lane is alike from both sides."""
    fields = {name: getattr(task, name).flip(1) for name in ("start_distance", "start_speed", "desired_speed")}
    return replace(task, **fields)


def test_the_start_of_a_task_by_hand(objects_config: RunConfig, objects_game: Game) -> None:
    task, by = draw_tasks(objects_config, 5), objects_of(objects_config).scales
    world = objects_game.simulator.reset(task)
    rows = objects_game.see(world)
    assert (rows.shape, rows.dtype) == ((5, *objects_game.observation_shape), torch.float32)
    own, others, _ = blocks(objects_config, rows)
    corridor_m = objects_config.scenario.road.street.corridor_length_m
    torch.testing.assert_close(own[:, SPEED] * by.speed_mps, task.start_speed[:, EGO])
    torch.testing.assert_close(own[:, DESIRED] * by.speed_mps, task.desired_speed[:, EGO])
    torch.testing.assert_close(own[:, TO_MOUTH] * by.distance_m, task.start_distance[:, EGO])
    torch.testing.assert_close(own[:, TO_END] * by.distance_m, task.start_distance[:, EGO] + corridor_m)
    assert own[:, HORIZON].eq(0).all()
    assert own[:, REST].eq(0).all()
    assert own[:, OWN:].abs().max() < 1e-5
    assert others[:, 0, [KNOWN, ONCOMING]].eq(1).all()
    assert others[:, 0, UNSEEN].eq(0).all()
    torch.testing.assert_close(others[:, 0, OTHER_SPEED] * by.speed_mps, task.start_speed[:, 1])
    torch.testing.assert_close(others[:, 0, APART] * by.distance_m, task.start_distance.sum(1) + corridor_m)
    for frame in range(objects_config.observation.n_frames):
        is_seen, to_mouth = others[:, 0, PER_OTHER + 3 * frame], others[:, 0, PER_OTHER + 3 * frame + 1]
        assert is_seen.eq(1).all()
        torch.testing.assert_close(to_mouth * by.distance_m, task.start_distance[:, 1])
    assert others[:, 1:].eq(0).all()


def test_the_past_and_the_last_horizon_by_hand(objects_config: RunConfig, objects_game: Game) -> None:
    config, world = objects_of(objects_config), driven(objects_game, draw_tasks(objects_config, 4), 12)
    own, others, _ = blocks(objects_config, objects_game.see(world))
    stride = config.frame_stride(objects_config.scenario.dt_s)
    x = world.pose_history[:, : 1 + config.history_steps(objects_config.scenario.dt_s) : stride, :, 0]
    torch.testing.assert_close(own[:, OWN:] * config.scales.distance_m, x[:, :1, 0] - x[:, 1:, 0], atol=1e-4, rtol=0)
    to_mouth = others[:, 0, PER_OTHER + 1 :: 3] * config.scales.distance_m
    torch.testing.assert_close(to_mouth[:, 1:] - to_mouth[:, :1], x[:, 1:, 1] - x[:, :1, 1], atol=1e-4, rtol=0)
    torch.testing.assert_close(own[:, HORIZON], torch.tensor([[1.0, 0.0, 2 / config.scales.time_s]]).expand(4, -1))
    gives_way = replace(world, last_horizon=torch.full_like(world.last_horizon, torch.inf))
    assert blocks(objects_config, objects_game.see(gives_way))[0][0, HORIZON].tolist() == [1, 1, 0]
    rested = replace(world, rest_steps=world.rest_steps + round(config.scales.time_s / objects_config.scenario.dt_s))
    torch.testing.assert_close(blocks(objects_config, objects_game.see(rested))[0][:, REST], torch.full((4,), 0.5))


@pytest.mark.parametrize("n_steps", [0, 30])
def test_both_seats_see_a_mirrored_task_alike(objects_config: RunConfig, objects_game: Game, n_steps: int) -> None:
    task = draw_tasks(objects_config, 8)
    task = replace(task, start_speed=task.start_speed * torch.tensor([0.6, 0.9]))
    world = driven(objects_game, task, n_steps, (2.0, 6.0))
    other = driven(objects_game, mirrored(task), n_steps, (6.0, 2.0))
    for vehicle in (0, 1):
        seats = (torch.full((8,), vehicle), torch.full((8,), 1 - vehicle))
        seen = (objects_game.see_as(each, seat) for each, seat in zip((world, other), seats, strict=True))
        torch.testing.assert_close(*seen, atol=1e-3, rtol=0)
    assert torch.equal(objects_game.see_as(world, torch.zeros(8, dtype=torch.int64)), objects_game.see(world))


def unseen(perception: Perception, frames: slice) -> Perception:
    """The perception of an agent that has not seen the others in these control steps."""
    is_seen = perception.is_seen_history.clone()
    is_seen[:, frames] = False
    now = perception.is_seen & is_seen[:, 0]
    return replace(
        perception,
        is_seen=now,
        other=map_tensors(lambda field: field * now.view(*now.shape, *[1] * (field.dim() - 3)), perception.other),
        is_seen_history=is_seen,
        other_history=perception.other_history * is_seen[..., None],
    )


def test_an_agent_knows_of_the_others_what_it_has_seen(objects_config: RunConfig, objects_game: Game) -> None:
    world, config = driven(objects_game, draw_tasks(objects_config, 3), 25), objects_of(objects_config)
    perception = objects_game.perceive(world).of(EGO)
    own, others, street = blocks(objects_config, objects_game.draw(perception))
    for n_steps in (1, 8):
        same_own, then, same_street = blocks(objects_config, objects_game.draw(unseen(perception, slice(0, n_steps))))
        assert torch.equal(own, same_own)
        assert torch.equal(street, same_street)
        assert then[:, 0, [KNOWN, ONCOMING]].eq(1).all()
        torch.testing.assert_close(
            then[:, 0, UNSEEN] * config.scales.time_s, torch.full((3,), n_steps * objects_config.scenario.dt_s)
        )
        assert then[:, 0, 3:PER_OTHER].eq(0).all()
        n_hidden = 1 + (n_steps - 1) // config.frame_stride(objects_config.scenario.dt_s)
        assert then[:, 0, PER_OTHER : PER_OTHER + 3 * n_hidden].eq(0).all()
        assert torch.equal(then[:, 0, PER_OTHER + 3 * n_hidden :], others[:, 0, PER_OTHER + 3 * n_hidden :])
    _, never, _ = blocks(objects_config, objects_game.draw(unseen(perception, slice(None))))
    assert never.eq(0).all()


def test_of_many_others_the_nearest_are_described() -> None:
    config = compose_config([*OBJECTS, "scenario.n_social=3", "observation.n_others=2"])
    game = build_game(config)
    world = game.simulator.reset(draw_tasks(config, 4))
    vehicles = map_tensors(torch.clone, world.vehicles)
    vehicles.position[0, 1:, 0] += torch.tensor([30.0, 0.0, -20.0])
    moved = place(world, vehicles)
    _, others, _ = blocks(config, game.see(moved))
    apart = (moved.vehicles.position[:, 1:, 0] - moved.vehicles.position[:, :1, 0]).sort(1).values[:, :2]
    shown = others[..., APART].sort(1).values * objects_of(config).scales.distance_m
    torch.testing.assert_close(shown, apart)


CHANGES: dict[str, Any] = {
    "n_frames": 3, "frame_interval_s": 0.8, "n_others": 5, "n_points": 20, "behind_m": 5.0, "ahead_m": 40.0,
}  # fmt: skip
SCALES = ("distance_m", "width_m", "speed_mps", "accel_mps2", "heading_rad", "curvature_1pm", "time_s", "largest")


@pytest.mark.parametrize("key", [*CHANGES, *SCALES])
def test_options_act(objects_config: RunConfig, objects_game: Game, key: str) -> None:
    config, world = objects_of(objects_config), driven(objects_game, draw_tasks(objects_config, 3), 25)
    if key in CHANGES:
        changed = replace(config, **{key: CHANGES[key]})
    else:
        value = 0.5 if key == "largest" else 2 * getattr(config.scales, key)
        changed = replace(config, scales=replace(config.scales, **{key: value}))
    perception = objects_game.perceive(world).of(EGO)
    rows, others = objects_game.draw(perception), observation(objects_game, changed).draw(perception)
    assert others.shape == (3, *changed.shape)
    assert rows.shape != others.shape or not torch.allclose(rows, others, atol=1e-3)


def test_no_number_is_larger_than_the_largest(objects_config: RunConfig, objects_game: Game) -> None:
    rows = objects_game.see(driven(objects_game, draw_tasks(objects_config, 16), 40))
    assert rows.isfinite().all()
    assert rows.abs().max() <= objects_of(objects_config).scales.largest


def test_a_long_history_than_the_observation_shows_changes_nothing(objects_config: RunConfig) -> None:
    """`perception.accel_window_s` makes worlds remember more than the frames."""
    longer = compose_config([*OBJECTS, "perception.accel_window_s=6.0", "perception.delay_s=0.4"])
    game = build_game(longer)
    assert game.see(driven(game, draw_tasks(longer, 2), 5)).shape == (2, *game.observation_shape)


def test_sizes_are_those_of_each_vehicle_and_a_longer_one_waits_farther_back() -> None:
    config = compose_config([*OBJECTS, "scenario/kind=[bus,cyclist]"])
    game, by = build_game(config), objects_of(config).scales
    world = game.simulator.reset(draw_tasks(config, 8))
    ego, its = (blocks(config, game.see_as(world, torch.full((8,), vehicle))) for vehicle in (0, 1))
    sizes = torch.stack([world.task.length, world.task.width], -1) / by.width_m
    assert sizes[:, 1, 0].unique().numel() == 2
    for seen, other, vehicle in ((ego, its, 0), (its, ego, 1)):
        torch.testing.assert_close(seen[0][:, OWN - 2 : OWN], sizes[:, vehicle])
        torch.testing.assert_close(other[1][:, 0, PER_OTHER - 2 : PER_OTHER], sizes[:, vehicle])
    to_wait = its[0][:, TO_MOUTH] - its[0][:, TO_MOUTH + 2]  # from its last waiting place to the mouth
    longer = (world.task.length[:, 1] - config.scenario.vehicle.length_m) / 2 / by.distance_m
    torch.testing.assert_close(to_wait - longer, (to_wait - longer).mean().expand(8))
