"""Stops with one level of deceleration: they go where they should, and what was planned stays a plan to its end."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from composed import compose_config
from games import draw_tasks, place
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.planner.braking import BrakingCandidates, BrakingConfig, StopConfig
from negopipe.simulation.road import RouteState
from negopipe.simulation.state import EGO, World
from negopipe.tensors.tree import map_tensors

N, DT_S = 400, 0.2
TIMES = torch.arange(1, 151) * DT_S
NONE = StopConfig([], [], [], 8.0)


def stops(group: StopConfig, times: Tensor = TIMES) -> BrakingCandidates:
    return BrakingCandidates(BrakingConfig(group, NONE, 7.0, 0.0, 0.0, None), times)


def states(seed: int = 0) -> RouteState:
    """Vehicles that can come to rest without driving backwards."""
    uniform = torch.rand(3, N, generator=torch.Generator().manual_seed(seed))
    speed, accel = uniform[0] * 5 + 1, uniform[1] * 4 - 2
    zero = torch.zeros(N)
    return RouteState(-25 + 10 * uniform[2], speed, accel, zero, zero, zero)


def test_a_stop_meets_its_place() -> None:
    route = states()
    samples = stops(StopConfig([], [-9.0, -5.5], [0.5], 8.0)).sample(route, torch.full((N,), 12.0))
    wanted = torch.stack([-9 - route.s, -5.5 - route.s, torch.full((N,), 11.5)])
    is_over = samples.speed[:, -1].abs() < 1e-3
    assert is_over.float().mean() > 0.9
    assert float((samples.travelled[:, -1] - wanted)[is_over].abs().max()) < 2e-3
    assert float(samples.speed.min()) > -1e-4


def test_a_level_is_held_and_never_exceeded() -> None:
    route = states()
    samples = stops(StopConfig([1.0, 3.0], [], [], 8.0)).sample(route, torch.full((N,), 50.0))
    for hardest, level in zip(samples.hardest, (1.0, 3.0), strict=True):
        braking_harder = (-route.s_ddot - 8.0 * DT_S).clamp(min=0)  # it takes a while until it is eased
        assert (hardest <= torch.maximum(braking_harder, torch.tensor(level)) + 1e-5).all()
    accel = samples.speed.diff(dim=1) / DT_S
    assert float((accel.amin(1) + samples.hardest).min()) > -1e-3


@pytest.mark.parametrize("jerk", [3.0, 8.0, 40.0])
def test_the_rest_of_a_stop_is_the_stop_planned_anew(jerk: float) -> None:
    candidates = stops(StopConfig([1.0, 3.5], [-9.0], [0.5], jerk))
    route, free = states(1), torch.full((N,), 11.0)
    planned = candidates.sample(route, free)
    for which in range(4):
        travelled, speed, accel = planned.travelled[which, 0], planned.speed[which, 0], planned.accel[which]
        later = route._replace(s=route.s + travelled, s_dot=speed.clamp(min=0), s_ddot=accel)
        again = candidates.sample(later, free - travelled)
        can_stop = route.s_dot > route.s_ddot.clamp(max=0) ** 2 / (2 * jerk)
        off = again.travelled[which, :-1] + travelled - planned.travelled[which, 1:]
        assert float(off[:, can_stop].abs().max()) < 2e-3


@pytest.fixture(scope="module")
def stopping_config() -> RunConfig:
    return compose_config(["planner=consistent_stops"])


@pytest.fixture(scope="module")
def stopping(stopping_config: RunConfig) -> Game:
    return build_game(stopping_config)


def nose_to_nose(config: RunConfig, game: Game, gap_m: float, speed: float) -> World:
    """The ego in the corridor at `speed`, `gap_m` from a vehicle that stands before it."""
    world = game.simulator.reset(draw_tasks(config, 1))
    position = torch.tensor([[[-5.5, 0.0], [-5.5 + 4.5 + gap_m, 0.0]]])
    return place(world, replace(world.vehicles, position=position, speed=torch.tensor([[speed, 0.0]])))


def test_standing_is_a_plan(stopping_config: RunConfig, stopping: Game, config: RunConfig, game: Game) -> None:
    six = torch.full((1, 2), 6.0)
    for c, g, is_emergency in ((config, game, True), (stopping_config, stopping, False)):
        world = nose_to_nose(c, g, gap_m=0.3, speed=0.0)  # closer than the clearance of 0.6 m
        motion = g.plan(g.perceive(world), six)
        assert bool(motion.is_full_braking[0, EGO]) == is_emergency
        assert (motion.state.speed == 0).all()
        torch.testing.assert_close(motion.state.position, world.vehicles.position, atol=1e-5, rtol=0)


def test_a_stop_that_was_planned_is_driven_to_its_end(stopping_config: RunConfig, stopping: Game) -> None:
    # 8 m to a vehicle that stands: nothing changes, so no decision brakes fully and none beyond comfort
    world = nose_to_nose(stopping_config, stopping, gap_m=8.0, speed=4.8)
    speeds = [4.8]
    for _ in range(40):
        motion = stopping.plan(stopping.perceive(world), torch.tensor([[6.0, 0.0]]))
        assert not motion.is_full_braking[0, EGO]
        held = map_tensors(torch.clone, motion.state)
        for field, before in ((held.position, world.vehicles.position), (held.yaw, world.vehicles.yaw)):
            field[:, 1] = before[:, 1]
        held.speed[:, 1], held.accel[:, 1] = 0.0, 0.0
        world, _ = stopping.simulator.step(world, held)
        speeds.append(float(world.vehicles.speed[0, EGO]))
    assert speeds[-1] == 0
    assert min(after - before for before, after in pairwise(speeds)) >= -4.05 * DT_S
    gap = float(world.vehicles.position[0, 1, 0] - world.vehicles.position[0, EGO, 0]) - 4.5
    assert 0.3 <= gap < 1.5


def test_a_hard_stop_is_planned_where_comfort_does_not_suffice(stopping_config: RunConfig, stopping: Game) -> None:
    seen = stopping.perceive(nose_to_nose(stopping_config, stopping, gap_m=3.4, speed=4.8))
    assert not stopping.plan(seen, torch.full((1, 2), 6.0)).is_full_braking[0, EGO]
    comfortable = build_game(compose_config(["planner=consistent_stops", "planner.braking.decel_max_mps2=3.9"]))
    assert comfortable.plan(seen, torch.full((1, 2), 6.0)).is_full_braking[0, EGO]


def test_yielding_begins_without_an_emergency(stopping_config: RunConfig, stopping: Game) -> None:
    task = draw_tasks(stopping_config, 16)
    distance = task.start_distance.clone()
    distance[:, 1] = torch.linspace(11.99, 14.02, 16)
    world = stopping.simulator.reset(replace(task, start_distance=distance))
    before, horizon = world.vehicles.speed[:, EGO], torch.tensor([[6.0, 2.0]]).expand(16, 2)
    hardest = torch.zeros(16)
    for _ in range(30):
        motion = stopping.plan(stopping.perceive(world), horizon)
        assert not motion.is_full_braking[:, EGO].any()
        world, _ = stopping.simulator.step(world, motion.state)
        hardest = torch.maximum(hardest, (before - world.vehicles.speed[:, EGO]) / DT_S)
        before = world.vehicles.speed[:, EGO]
    assert not world.has_collided.any()
    assert float(hardest.max()) <= 4.05


OPTIONS = [
    "planner.braking.slack_m=0.0", "planner.braking.room_m=9.0",
    "planner.braking.standing_m=null", "planner.braking.hard.decels_mps2=[6.9]",
    "planner.braking.comfortable.margins_m=[2.0]", "planner.braking.comfortable.jerk_mps3=3.0",
    "planner.braking.comfortable.decels_mps2=[]", "planner.braking.comfortable.positions_m=[-8.0]",
    "planner.cost.hard_braking=0.0", "planner.cost.closeness=0.0",
]  # fmt: skip


@pytest.mark.parametrize("option", OPTIONS)
def test_options_of_stops_act(stopping_config: RunConfig, stopping: Game, option: str) -> None:
    other = build_game(compose_config(["planner=consistent_stops", option]))
    world = stopping.simulator.reset(draw_tasks(stopping_config, 16))
    horizon, n_different = torch.tensor([[6.0, 2.0], [4.0, 0.0]]).repeat(8, 1), 0
    for step in range(18):
        if step == 3:  # who now predicts the other farther has to brake hard
            horizon = torch.full_like(horizon, 6.0)
        seen = stopping.perceive(world)
        motion, again = stopping.plan(seen, horizon), other.plan(seen, horizon)
        is_same = (motion.state.speed == again.state.speed) & (motion.is_full_braking == again.is_full_braking)
        n_different += int((~is_same).sum())
        world, _ = stopping.simulator.step(world, motion.state)
    assert n_different > 0


@pytest.mark.slow
def test_a_batch_equals_single_worlds_and_compiled_equals_eager(stopping_config: RunConfig, stopping: Game) -> None:
    world = stopping.simulator.reset(draw_tasks(stopping_config, 16))
    pairs = torch.cartesian_prod(torch.tensor([0.0, 2.0, 4.0, 6.0]), torch.tensor([0.0, 2.0, 4.0, 6.0]))
    compiled = build_game(stopping_config, "cpu", is_compiled=True)
    for step in range(24):
        together = stopping.plan(stopping.perceive(world), pairs)
        if step % 6 == 0:
            same = [stopping.plan(stopping.perceive(map_tensors(lambda f: f[5:6], world)), pairs[5:6])]
            rows = [map_tensors(lambda f: f[5:6], together)]
            same.append(compiled.plan(stopping.perceive(world), pairs))
            rows.append(together)
            for a, b in zip(same, rows, strict=True):
                map_tensors(lambda x, y: torch.testing.assert_close(x, y, atol=1e-4, rtol=1e-4) or x, a, b)
        world, _ = stopping.simulator.step(world, together.state)
