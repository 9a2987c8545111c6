"""Collisions are seen wherever they happen: at control steps, between them, among others."""

import math
from dataclasses import replace

import pytest
import torch
from composed import compose_config
from games import draw_tasks, place
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.simulation.collisions import GRAZE_M, CollisionCheck
from negopipe.simulation.geometry import Size, boxes_from_pose, overlap_depth
from negopipe.simulation.one_street import OneStreet
from negopipe.simulation.perception import other_columns
from negopipe.simulation.state import EGO, VehicleState, World
from negopipe.tensors.tree import map_tensors

COARSE = {
    dt: [f"scenario.dt_s={dt}", f"observation.frame_interval_s={dt}", f"perception.accel_window_s={dt}"]
    for dt in (1.0, 2.0)
}
DENSE = 2000
CAR = Size(4.5, 1.8)


@pytest.mark.parametrize(
    "overrides",
    [COARSE[1.0], COARSE[2.0], ["scenario.vehicle.length_m=1.0"], ["scenario.vehicle.length_m=0.3"]],
    ids=["dt 1 s", "dt 2 s", "length 1 m", "length 0.3 m"],
)
def test_nobody_passes_through_anybody(overrides: list[str]) -> None:
    config = compose_config(overrides)
    game = build_game(config)
    world, blind = game.simulator.reset(draw_tasks(config, 64)), torch.zeros(64, 2)
    has_met = torch.zeros(64, 2, dtype=torch.bool)
    for _ in range(round(8.0 / config.scenario.dt_s)):
        before = world.has_collided
        world = game.drive(world, blind).world
        is_new = world.has_collided & ~before
        has_met |= is_new & game.simulator.touches(world)  # the record shows them where they met
    assert has_met.all()


def along(state: VehicleState) -> Tensor:
    """[E, V]: everybody drives along the line of the first street."""
    return torch.ones_like(state.speed)


def vehicles(x: Tensor, y: Tensor, yaw: Tensor, speed: Tensor) -> VehicleState:
    """All [E, V]."""
    return VehicleState(torch.stack([x, y], -1), yaw, speed, torch.zeros_like(x), torch.zeros_like(x))


def random_motion(generator: torch.Generator, n: int, dt_s: float) -> tuple[VehicleState, VehicleState]:
    """Two vehicles on arcs that cross each other's way somewhere beside the parked cars, before and after a step."""
    draw = torch.rand(n, 2, 5, generator=generator)
    x, y, yaw = 6 * draw[..., 0] - 33, 2 * draw[..., 1] - 1, 2 * math.pi * draw[..., 2]
    speed, turn = 6 * draw[..., 3], (draw[..., 4] - 0.5) * min(1.0, 1.2 * dt_s)
    before = vehicles(x, y, yaw, speed)
    chord = speed * dt_s * torch.sinc(turn / 2 / math.pi)
    mid = yaw + turn / 2
    return before, vehicles(x + chord * mid.cos(), y + chord * mid.sin(), yaw + turn, speed)


def deepest(before: VehicleState, after: VehicleState, dt_s: float, size: Size) -> Tensor:
    """[E] m: deepest overlap of the two vehicles on their cubics, tried out at many moments; the first one left out."""
    t = torch.linspace(0, 1, DENSE + 1)[1:]
    boxes = []
    for i in (0, 1):
        a, b = (map_tensors(lambda field, i=i: field[:, i], state) for state in (before, after))
        velocity = [(s.speed * dt_s)[:, None] * torch.stack([s.yaw.cos(), s.yaw.sin()], -1) for s in (a, b)]
        place = a.position[..., None] + (b.position - a.position)[..., None] * (3 * t**2 - 2 * t**3)
        place = place + velocity[0][..., None] * t * (1 - t) ** 2 + velocity[1][..., None] * t**2 * (t - 1)
        yaw = a.yaw[:, None] + t * (b.yaw - a.yaw)[:, None]
        boxes.append(boxes_from_pose(place[:, 0], place[:, 1], yaw, *size))
    return overlap_depth(*boxes).amax(-1)


@pytest.mark.parametrize("dt_s", [0.2, 1.0])
def test_contacts_agree_with_trying_out(config: RunConfig, dt_s: float) -> None:
    size, wide = Size(1.2, 0.5), OneStreet(replace(config.scenario.road, width_m=200.0).street)
    check = CollisionCheck(wide, dt_s, other_columns(2))
    before, after = random_motion(torch.Generator().manual_seed(3), 3000, dt_s)
    is_apart = ~check.touches(before, along(before), size).any(-1)
    before, after = (map_tensors(lambda field: field[is_apart], state) for state in (before, after))
    found = check.first_contact(before, after, along(before), size).isfinite()
    depth = deepest(before, after, dt_s, size)
    assert torch.equal(found[:, 0], found[:, 1])
    turned = (after.yaw - before.yaw).abs().amax(-1)
    n_pieces = round(dt_s / 0.05)
    graze = 2 * (GRAZE_M + math.hypot(1.2, 0.5) / 2 * turned / n_pieces / 2)  # of both footprints
    assert not found[depth <= 0].any()
    assert found[depth > 2 * graze].all()
    is_between = found.any(-1) & ~check.touches(after, along(after), size).any(-1)
    assert is_between.sum() > 10  # seen on the way only


def test_contact_time_by_hand(config: RunConfig, game: Game) -> None:
    check = game.simulator.collisions
    still = torch.zeros(1, 2)
    before = vehicles(
        torch.tensor([[-40.0, -30.0]]), still, torch.tensor([[0.0, math.pi]]), torch.tensor([[50.0, 0.0]])
    )
    after = replace(before, position=before.position + torch.tensor([[[10.0, 0.0], [0.0, 0.0]]]))
    share = check.first_contact(before, after, along(before), CAR)
    torch.testing.assert_close(share, torch.ones(1, 2))  # they overlap at the end, too
    farther = replace(after, position=after.position + torch.tensor([[[20.0, 0.0], [0.0, 0.0]]]))
    fast = replace(before, speed=torch.tensor([[150.0, 0.0]]))
    share = check.first_contact(fast, replace(farther, speed=fast.speed), along(fast), CAR)
    torch.testing.assert_close(share, torch.full((1, 2), 5.5 / 30), atol=2e-3, rtol=0)  # 4.5 m long, 10 m apart
    beside = replace(farther, position=farther.position + torch.tensor([[[0.0, 1.9], [0.0, 0.0]]]))
    passing = replace(fast, position=fast.position + torch.tensor([[[0.0, 1.9], [0.0, 0.0]]]))
    assert check.first_contact(passing, replace(beside, speed=fast.speed), along(passing), CAR).isinf().all()


def test_a_kerb_is_met_between_two_steps(game: Game) -> None:
    check = CollisionCheck(game.simulator.road, 2.0, other_columns(2))
    x, there = torch.tensor([[-40.0, 30.0]]), torch.tensor([[-30.0, 30.0]])
    y, yaw, speed = torch.full((1, 2), -2.5), torch.tensor([[-0.4, math.pi]]), torch.tensor([[5.0, 0.0]])
    before, after = vehicles(x, y, 0 * yaw, speed), vehicles(there, y, 0 * yaw, speed)
    assert check.first_contact(before, after, along(before), CAR).isinf().all()
    bulging = check.first_contact(vehicles(x, y, yaw, speed), vehicles(there, y, -yaw, speed), along(before), CAR)
    assert bulging.isfinite().tolist() == [[True, False]]


def with_crash_behind(game: Game, config: RunConfig, ego: tuple[float, float], wrecks: tuple[float, float]) -> World:
    """The ego at (x, y), the last two of three social vehicles in each other at x = `wrecks`, in their lane."""
    world = game.simulator.reset(draw_tasks(config, 1))
    x = torch.tensor([[ego[0], 60.0, *wrecks]])
    y = torch.tensor([[ego[1], 1.75, 1.75, 1.75]])
    yaw = torch.tensor([[0.0, math.pi, math.pi, math.pi]])
    return place(world, vehicles(x, y, yaw, torch.zeros_like(x)))


def test_a_crash_of_others_is_theirs(three_social_config: RunConfig, three_social: Game) -> None:
    world = with_crash_behind(three_social, three_social_config, (-20.0, -1.75), (40.0, 42.0))
    after, events = three_social.simulator.step(world, world.vehicles)
    assert after.has_collided.tolist() == [[False, False, True, True]]
    assert events.is_social_collision
    assert not events.is_collision
    assert not events.is_terminated
    assert not events.is_truncated  # they stand in their own lane, where the ego can pass
    moving = replace(after.vehicles, position=after.vehicles.position + 0.5, speed=after.vehicles.speed + 2.5)
    later, events = three_social.simulator.step(after, moving)
    assert torch.equal(later.vehicles.position[0, 2:], after.vehicles.position[0, 2:])
    assert not later.vehicles.speed[0, 2:].any()
    assert later.vehicles.speed[0, EGO] == 2.5
    assert events.is_social_collision


def test_a_crash_that_closes_the_egos_way_ends_the_episode(three_social_config: RunConfig, three_social: Game) -> None:
    world = with_crash_behind(three_social, three_social_config, (-20.0, -1.75), (2.0, 4.0))
    y = world.vehicles.position[..., 1].clone()
    y[0, 2:] = 0.0
    x = world.vehicles.position[..., 0]
    in_corridor = place(world, replace(world.vehicles, position=torch.stack([x, y], -1)))
    _, events = three_social.simulator.step(in_corridor, in_corridor.vehicles)
    assert events.is_social_collision
    assert events.is_truncated
    assert not events.is_terminated
    beyond = place(in_corridor, replace(in_corridor.vehicles, position=in_corridor.vehicles.position.clone()))
    beyond.vehicles.position[0, EGO, 0] = 12.0
    _, events = three_social.simulator.step(beyond, beyond.vehicles)
    assert not events.is_truncated  # it lies behind the ego


def test_after_a_crash_of_others_the_egos_arrival_is_success(
    three_social_config: RunConfig, three_social: Game
) -> None:
    road = three_social_config.scenario.road
    there = road.corridor_length_m / 2 + road.target_distance_m
    world = with_crash_behind(three_social, three_social_config, (there - 0.5, -1.75), (-30.0, -32.0))
    x = world.vehicles.position + torch.tensor([[[1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]])
    after, events = three_social.simulator.step(world, replace(world.vehicles, position=x))
    assert after.has_reached.tolist() == [[True, False, True, True]]
    assert events.is_success
    assert events.is_social_collision
    assert events.is_terminated


def test_an_ego_that_drives_into_a_crash_has_collided(three_social_config: RunConfig, three_social: Game) -> None:
    world = with_crash_behind(three_social, three_social_config, (30.0, 1.75), (34.0, 36.0))
    _, events = three_social.simulator.step(world, world.vehicles)
    assert events.is_collision
    assert not events.is_social_collision
