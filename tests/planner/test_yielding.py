"""Who waits makes room: pulling aside, the places to stop at, and the other options that act on the outcome."""

from functools import cache
from typing import NamedTuple

import pytest
import torch
from composed import compose_config
from torch import Tensor

from negopipe.game.game import Game, build_game
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO, Motion, World

N_WORLDS, N_STEPS = 24, 128


class Outcome(NamedTuple):
    """is_success: [E] bool; s, beside: [D] m, where the ego rested before the corridor, how far left of its route"""

    is_success: Tensor
    s: Tensor
    beside: Tensor


@cache
def negotiate(ego_s: float, *overrides: str) -> Outcome:
    """The yield family: the ego predicts `ego_s` seconds, the other two, and comes first."""
    config = compose_config(overrides)
    game, families = build_game(config), {"yield": config.scenario.families["yield"]}
    task = TaskSampler(config.scenario, families, torch.Generator().manual_seed(0)).draw(N_WORLDS)
    world, horizon = game.simulator.reset(task), torch.tensor([[ego_s, 2.0]]).expand(N_WORLDS, 2)
    is_success, rests = torch.zeros(N_WORLDS, dtype=torch.bool), []
    for _ in range(N_STEPS):
        world, events, *_ = game.drive(world, horizon)
        is_success |= events.is_success
        road = game.simulator.road
        route = road.to_route(world.vehicles, task.direction)
        beside = route.d - road.route_offset(route.s, task.direction)[0]
        waits = (world.vehicles.speed[:, EGO] < 0.1) & (route.s[:, EGO] < 0) & (world.step > 5)
        rests.append(torch.stack([route.s[waits, EGO], beside[waits, EGO]]))
        if is_success.all():
            break
    return Outcome(is_success & ~world.has_collided.any(-1), *torch.cat(rests, dim=1))


def test_who_waits_pulls_aside() -> None:
    aside, straight = negotiate(6.0), negotiate(6.0, "planner.lateral.offsets_m=[0.0]")
    assert aside.is_success.all()
    assert straight.is_success.all()
    assert len(straight.s) > 50
    assert float(straight.beside.abs().max()) < 0.02
    assert 0 < len(aside.s) < len(straight.s) / 2  # and it waits less
    assert float(aside.beside.mean()) < -0.08


def test_more_get_through_where_the_waiting_one_can_pull_aside() -> None:
    # a prediction of 4 s sees the other late, when only a step aside lets it pass
    aside, straight = negotiate(4.0), negotiate(4.0, "planner.lateral.offsets_m=[0.0]")
    assert aside.is_success.sum() >= straight.is_success.sum() + 4


def test_stop_positions_change_where_the_waiting_one_rests() -> None:
    anywhere, there = negotiate(6.0, "planner.longitudinal.stop_positions_m=[]"), negotiate(6.0)
    assert anywhere.is_success.all()
    assert there.is_success.all()
    assert float((there.s + 9.0).abs().mean()) < 0.3  # -9 m is one of the positions
    assert float((anywhere.s + 9.0).abs().mean()) > 0.5
    assert len(there.s) < len(anywhere.s)


def first_plan(game: Game, world: World) -> Motion:
    return game.plan(game.perceive(world), torch.tensor([[6.0, 2.0]]).expand(len(world.task), 2))


@pytest.mark.parametrize("option", ["limits.jerk_max_mps3=1.5", "clearance.conflict_station_m=6.0"])
def test_limits_and_spacing_act(option: str) -> None:
    config = compose_config()
    game, changed = build_game(config), build_game(compose_config([f"planner.{option}"]))
    families = {"yield": config.scenario.families["yield"]}
    task = TaskSampler(config.scenario, families, torch.Generator().manual_seed(0)).draw(N_WORLDS)
    world, n_different = game.simulator.reset(task), 0
    for _ in range(40):
        motion = first_plan(game, world)
        other = first_plan(changed, world)
        n_different += int((motion.state.accel - other.state.accel).abs().gt(1e-3).sum())
        world, _ = game.simulator.step(world, motion.state)
    assert n_different > 10


def test_conflict_stations_are_as_close_as_asked() -> None:
    fine, coarse = (build_game(compose_config([f"planner.clearance.conflict_station_m={m}"])) for m in (0.6, 3.0))
    assert len(fine.planner.conflicts.around) > 4 * len(coarse.planner.conflicts.around)
    steps = [planner.planner.conflicts.around.diff().amax() for planner in (fine, coarse)]
    assert float(steps[0]) <= 0.6 + 1e-5
    assert float(steps[1]) <= 3.0 + 1e-5
