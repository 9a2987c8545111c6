"""Reversing: who stands in the way of an oncoming one, and predicts it far enough, makes room backwards."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from composed import compose_config
from games import draw_tasks, drive, meet
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.simulation.geometry import boxes_from_pose, overlap_depth
from negopipe.simulation.state import EGO, VehicleState, World
from negopipe.tensors.tree import map_tensors

INF = math.inf
STREETS = ["narrow_lane", pytest.param("bent_street", marks=pytest.mark.slow), "one_sided"]
NOSE_TO_NOSE = [3.0, 3.5]
"""s of the two, m: 1 m is between their noses."""


def built(*overrides: str) -> tuple[RunConfig, Game]:
    config = compose_config(["planner=reversing", *overrides])
    return config, build_game(config)


@pytest.fixture(scope="module")
def narrow() -> tuple[RunConfig, Game]:
    return built()


def stand(config: RunConfig, game: Game, s: list[list[float]]) -> World:
    return meet(config, game, s, [[0.0] * len(s[0])] * len(s))


def progress(game: Game, worlds: list[World]) -> Tensor:
    """[T, E, V] m"""
    return torch.stack([game.simulator.road.progress(w.vehicles.position, w.task.direction) for w in worlds])


@pytest.mark.parametrize("street", STREETS)
def test_nose_to_nose_the_one_that_predicts_far_makes_room(street: str) -> None:
    config, game = built(f"scenario={street}")
    pairs = [(6.0, 2.0), (6.0, 4.0), (2.0, 6.0), (INF, 2.0), (6.0, 6.0), (INF, INF)]
    world = stand(config, game, [NOSE_TO_NOSE] * len(pairs))
    worlds = drive(game, world, torch.tensor(pairs), config.scenario.episode_steps)
    assert not worlds[-1].has_collided.any()
    assert worlds[-1].has_reached.all()
    back = progress(game, worlds[:1])[0] - progress(game, worlds).amin(0)
    one_by_six = torch.tensor([[True, False], [True, False], [False, True], [True, False]])
    assert ((back[:4] > 5.0) == one_by_six).all()
    assert ((back[4:] > 5.0).sum(1) == 1).all()  # of two the one with the shorter way back


def test_a_short_prediction_is_not_enough(narrow: tuple[RunConfig, Game]) -> None:
    config, game = narrow
    worlds = drive(game, stand(config, game, [NOSE_TO_NOSE]), torch.tensor([[4.0, 4.0]]), 20)
    assert (torch.stack([world.vehicles.speed for world in worlds]) == 0).all()


def test_who_reverses_does_so_at_walking_pace(narrow: tuple[RunConfig, Game]) -> None:
    config, game = narrow
    worlds = drive(game, stand(config, game, [[8.0, 0.0], [3.0, 3.5]]), torch.tensor([[6.0, 2.0]]).expand(2, 2), 90)
    speed = torch.stack([w.vehicles.speed[:, EGO] for w in worlds])
    assert -1.5 * 1.05 <= float(speed.min()) < -1.4
    slowest = speed.argmin(0)
    for world in range(2):
        changes = speed[: int(slowest[world]) + 30, world].diff() / 0.2
        assert float(changes.min()) >= -1.05
        backwards = speed[: int(slowest[world]) + 30, world][1:] < 0
        assert float(changes[backwards].max()) <= 1.05
    rest = progress(game, worlds)[:, :, EGO].amin(0)
    assert ((rest < -9.0) & (rest >= -11.02)).all()  # from where the other can pass to 2 m behind it


def test_who_lets_nobody_pass_but_can_go_on_does_not_reverse(narrow: tuple[RunConfig, Game]) -> None:
    config, game = narrow
    worlds = drive(game, stand(config, game, [[3.0, -40.0]]), torch.tensor([[6.0, 2.0]]), 20)
    assert (torch.stack([w.vehicles.speed for w in worlds]) >= 0).all()


def test_nobody_reverses_into_a_follower() -> None:
    config, game = built("scenario.n_social=2")
    # the second social vehicle stands close behind the first one, which may not reverse, then far, then comes
    s = [[3.0, 3.5, -2.5], [3.0, 3.5, -30.0], [3.0, 3.5, -30.0]]
    world = meet(config, game, s, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    motion = game.plan(game.perceive(world), torch.tensor([[2.0, 6.0, 2.0]]).expand(3, 3))
    assert (motion.state.speed[:, 1] < 0).tolist() == [False, True, False]


def test_who_reverses_stops_for_one_that_comes_from_behind() -> None:
    config, game = built("scenario.n_social=2")
    world = stand(config, game, [[3.0, 3.5, -40.0]])
    horizon = torch.tensor([[2.0, 6.0, 2.0]])
    world = drive(game, world, horizon, 8)[-1]
    assert float(world.vehicles.speed[0, 1]) < -1
    near = replace(world.vehicles, position=world.vehicles.position.clone())
    near.position[0, 2, 0] = near.position[0, 1, 0] + 4.5 + 2.5  # against the line is towards -x
    worlds = drive(game, game.simulator.place(world, near), horizon, 8)
    assert worlds[-1].vehicles.speed[0, 1] >= 0
    assert not worlds[-1].has_collided.any()


def test_who_stops_reversing_is_soon_at_rest_and_drives_on(narrow: tuple[RunConfig, Game]) -> None:
    config, game = narrow
    world = drive(game, stand(config, game, [NOSE_TO_NOSE]), torch.tensor([[6.0, 2.0]]), 10)[-1]
    assert float(world.vehicles.speed[0, EGO]) < -1
    worlds = drive(game, world, torch.tensor([[0.0, 6.0]]), 12)
    assert float(worlds[-1].vehicles.speed[0, EGO]) > 0


def test_noise_hides_no_reversing() -> None:
    for tracker in ([], ["perception.tracker=null"]):
        config, game = built("perception=noisy", *tracker)
        worlds = drive(game, stand(config, game, [NOSE_TO_NOSE] * 8), torch.tensor([[6.0, 2.0]]).expand(8, 2), 14)
        seen = game.perceive(worlds[-1]).of(1)
        assert float(worlds[-1].vehicles.speed[:, EGO].mean()) < -1
        assert float(seen.other.speed[seen.is_seen].mean()) < -0.7


def test_a_car_reverses_as_planned() -> None:
    config, game = built("dynamics=bicycle")
    worlds = drive(game, stand(config, game, [NOSE_TO_NOSE]), torch.tensor([[6.0, 2.0]]), config.scenario.episode_steps)
    assert not worlds[-1].has_collided.any()
    assert worlds[-1].has_reached.all()
    off = torch.stack([(w.vehicles.position - w.reference.position).norm(dim=-1) for w in worlds])
    assert float(off.max()) < 0.3
    assert float(torch.stack([w.vehicles.speed for w in worlds]).min()) < -1


def test_mirrored_and_batched(narrow: tuple[RunConfig, Game]) -> None:
    config, game = narrow
    start = [[3.0, 3.5], [6.0, 1.0], [1.0, 5.0]]
    horizon = torch.tensor([[6.0, 2.0], [6.0, 6.0], [INF, INF]])
    world = stand(config, game, start)
    worlds = drive(game, world, horizon, 60)
    swapped = stand(config, game, [row[::-1] for row in start])
    swapped = replace(swapped, task=replace(swapped.task, desired_speed=swapped.task.desired_speed.flip(1)))
    mirrored = drive(game, swapped, horizon.flip(1), 60)
    alone = drive(game, map_tensors(lambda f: f[1:2], world), horizon[1:2], 60)
    for one, other, single in zip(worlds, mirrored, alone, strict=True):
        torch.testing.assert_close(one.vehicles.position, -other.vehicles.position.flip(1), atol=2e-3, rtol=0)
        torch.testing.assert_close(one.vehicles.position[1:2], single.vehicles.position, atol=1e-3, rtol=0)


def test_without_anybody_in_the_way_nothing_changes(narrow: tuple[RunConfig, Game]) -> None:
    config, with_it = narrow
    without = build_game(compose_config(["planner=consistent_stops"]))
    world = without.simulator.reset(draw_tasks(config, 16))
    horizon = torch.tensor([[6.0, 2.0], [0.0, 4.0]]).repeat(8, 1)
    for _ in range(20):
        motion = without.plan(without.perceive(world), horizon)
        again = with_it.plan(with_it.perceive(world), horizon)
        assert torch.equal(motion.state.position, again.state.position)
        world, _ = without.simulator.step(world, motion.state)


OPTIONS = [
    "least_horizon_s=6.2", "speed_mps=0.5", "accel_mps2=0.3", "length_m=5.0", "beyond_m=0.0", "return_m=2.0",
    "behind_m=30.0",
]  # fmt: skip


@cache
def driven_on(*overrides: str) -> Tensor:
    """[2, 3, 2] m: places of three after 2.4 s."""
    config, game = built("scenario.n_social=2", *overrides)
    world = stand(config, game, [[3.0, 3.5, -40.0], [-2.0, 8.5, -40.0]])
    aside = replace(world.vehicles, position=world.vehicles.position + torch.tensor([0.0, -0.1]))
    world, horizon = game.simulator.place(world, aside), torch.tensor([[2.0, 6.0, 2.0]]).expand(2, 3)
    return drive(game, world, horizon, 12)[-1].vehicles.position


@pytest.mark.parametrize("option", OPTIONS)
def test_options_act(option: str) -> None:
    assert float((driven_on() - driven_on(f"planner.reversing.{option}")).abs().max()) > 0.01


@pytest.mark.parametrize("makes_room", ["false", "true"])
def test_random_drives_stay_sound(makes_room: str) -> None:
    """Random horizons from wide starts: finite, within the limits, and nobody reverses into anybody."""
    room = f"planner.reversing.makes_room={makes_room}"
    config, game = built("scenario.n_social=3", "scenario.social_spacing_m=7.0", room)
    n, draws = 16, torch.Generator().manual_seed(3)
    world, horizons = game.simulator.reset(draw_tasks(config, n)), torch.tensor([0.0, 2.0, 4.0, 6.0, INF])
    kept, n_backwards, horizon = torch.zeros(n, dtype=torch.bool), 0, torch.zeros(n, 4)
    for step in range(70):
        if step % 10 == 0:
            horizon = horizons[torch.randint(5, (n, 4), generator=draws)]
        motion = game.plan(game.perceive(world), horizon)
        assert all(torch.isfinite(f).all() for f in (motion.state.position, motion.state.yaw, motion.state.speed))
        assert float(motion.state.speed.min()) >= -1.5 * 1.1
        before, (world, _) = world, game.simulator.step(world, motion.state)
        backwards = motion.state.speed < -0.1
        n_backwards += int((backwards & ~kept[:, None]).sum())
        assert not (hits_behind(config, before.vehicles, motion.state) & backwards & ~kept[:, None]).any()
        kept |= world.has_collided.any(1)
    assert n_backwards > 20


def hits_behind(config: RunConfig, before: VehicleState, after: VehicleState) -> Tensor:
    """[E, V] bool: a vehicle overlaps another one that rested, and did not before."""
    size = config.scenario.vehicle

    def overlaps(own: VehicleState, others: VehicleState) -> Tensor:
        boxes = [
            boxes_from_pose(*state.position.unbind(-1), state.yaw, size.length_m, size.width_m)
            for state in (own, others)
        ]
        mine, its = (
            b._replace(**{k: getattr(b, k).unsqueeze(axis) for k in ("x", "y", "cos", "sin")})
            for b, axis in zip(boxes, (2, 1), strict=True)
        )
        return (overlap_depth(mine, its) > 0) & (others.speed.abs() < 0.1)[:, None] & ~torch.eye(4, dtype=torch.bool)

    return (overlaps(after, before) & ~overlaps(before, before)).any(2)


@pytest.mark.parametrize("makes_room", [False, True])
def test_who_stands_behind_one_that_has_to_drive_back_drives_back_first(makes_room: bool) -> None:
    """Nose to nose, the ego has two close behind it, which predict little."""
    config, game = built("scenario.n_followers=2", f"planner.reversing.makes_room={makes_room}".lower())
    n_steps = 120 if makes_room else 20
    worlds = drive(game, stand(config, game, [[3.0, 3.5, -3.0, -9.0]]), torch.tensor([[6.0, 2.0, 2.0, 0.0]]), n_steps)
    s, speed = progress(game, worlds)[:, 0], torch.stack([world.vehicles.speed[0] for world in worlds])
    assert not worlds[-1].has_collided.any()
    assert bool(worlds[-1].has_reached[0, 1]) == makes_room
    assert bool((speed[:, [EGO, 2, 3]].amin(0) < -1).all()) == makes_room
    if makes_room:
        first_back = (speed[:, [3, 2, EGO]] < 0).int().argmax(0)
        assert (first_back.diff() > 0).all()  # the last one first
        assert s[-1, EGO] > s[:, EGO].min() + 1  # and goes on, once the other is through
    else:
        assert (speed == 0).all()


def test_nobody_makes_room_for_one_that_can_be_passed_or_drives_on() -> None:
    config, game = built("scenario.n_followers=1", "planner.reversing.makes_room=true")
    # it stands where the other can pass; it drives; nobody comes near
    world = meet(
        config,
        game,
        [[-12.0, 3.5, -18.0], [3.0, 3.5, -3.0], [3.0, -20.0, -3.0]],
        [[0.0, 0.0, 0.0], [3.0, 0.0, 3.0], [0.0, 3.0, 0.0]],
    )
    motion = game.plan(game.perceive(world), torch.zeros(3, 3))
    assert (motion.state.speed[:, 2] >= 0).all()
