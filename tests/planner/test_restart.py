"""Who stopped can drive on: what was drivable from afar stays so from near, small errors of tracking included."""

import pytest
import torch
from composed import compose_config
from games import place

from negopipe.config.root import RunConfig
from negopipe.game.game import build_game
from negopipe.planner.street_planner import StreetPlanner
from negopipe.simulation.road import RouteState
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO
from negopipe.tensors.tree import map_tensors


def pushed(config: RunConfig, n: int) -> TaskSampler:
    families = {"push": config.scenario.families["push"]}
    return TaskSampler(config.scenario, families, torch.Generator().manual_seed(n))


def test_a_car_that_lags_behind_its_plan_leaves_the_place_where_it_waited() -> None:
    config = compose_config(["dynamics=bicycle"])
    game = build_game(config)
    world = game.simulator.reset(pushed(config, 48).draw(48))
    horizon = torch.tensor([[0.0, 6.0]]).expand(48, 2)
    for _ in range(config.scenario.episode_steps):
        world = game.drive(world, horizon).world
        if world.has_reached.all():
            break
    assert world.has_reached.all()
    assert not world.has_collided.any()


def test_a_car_at_rest_beside_the_kerb_with_its_wheels_turned_drives_on() -> None:
    # 0.2 m from the kerb; turned to the left, its tail swings out to the right by a few centimetres
    config = compose_config()
    game = build_game(config)
    world = game.simulator.reset(pushed(config, 1).draw(1))
    there = torch.tensor([-9.0])
    rest = RouteState(there, there * 0, there * 0, there * 0 - 2.152, there * 0 + 0.085, there * 0 + 0.117)
    ego = game.simulator.road.to_world(rest, world.task.direction[:, EGO])
    vehicles = map_tensors(lambda all_, one: all_.index_copy(1, torch.tensor([EGO]), one[:, None]), world.vehicles, ego)
    world = place(world, vehicles)
    for _ in range(15):
        motion = game.plan(game.perceive(world), torch.zeros(1, 2))
        world, _ = game.simulator.step(world, motion.state)
    assert float(world.vehicles.speed[0, EGO]) > 2
    assert not world.has_collided[0, EGO]


@pytest.mark.parametrize(("planner", "starts_again"), [("reversing", False), ("traffic", True)])
def test_a_car_at_rest_on_its_route_enters_a_corridor_that_leaves_it_a_third_of_a_metre(
    planner: str, starts_again: bool
) -> None:
    """The route itself comes 0.19 m near to the last car, which `reversing` takes for too near from 4 m ahead on."""
    street = StreetPlanner.of("narrow_lane", planner, road={"corridor_gap_m": 2.46})
    s = torch.tensor([-8.0, -7.5, -7.0])  # the corridor's mouth is 0
    rest = RouteState(s, s * 0, s * 0, *street.road.route_offset(s, torch.ones(3)))
    at = street.road.to_world(rest, torch.ones(3))
    vehicles = torch.stack([*at.position.unbind(-1), at.yaw, at.speed, at.accel, at.curvature], -1)
    plans = street.plan(vehicles, None, horizon_s=0.0, desired_speed_mps=6.0)
    assert (plans.states.position[:, -1, 0] > -2).tolist() == [starts_again] * 3
    assert not plans.is_full_braking.any()
