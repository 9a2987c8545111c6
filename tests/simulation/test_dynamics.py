"""A bicycle on circles and in a straight line by hand, late commands, and how closely it follows the plan."""

import math
from dataclasses import replace

import pytest
import torch
from composed import compose_config
from games import draw_tasks

from negopipe.config.root import RunConfig
from negopipe.game.game import build_game
from negopipe.simulation.dynamics import Bicycle, BicycleConfig
from negopipe.simulation.state import VehicleState

AT_ONCE = BicycleConfig("bicycle", 2.7, 35.0, 1e5, 1e-4, 1e-4, 0.0, 4, 1.0, 0.5, 0.2, 1.0)


def one(speed: float, curvature: float = 0.0) -> VehicleState:
    zero = torch.zeros(1, 1)
    return VehicleState(torch.zeros(1, 1, 2), zero, zero + speed, zero, zero + curvature)


def command(accel: float, steer: float) -> torch.Tensor:
    return torch.tensor([[[accel, steer]]])


def test_constant_steering_is_a_circle() -> None:
    car, curvature = Bicycle(AT_ONCE, 0.2), 0.1
    state = one(4.0, curvature)
    for step in range(1, 40):
        state = car.actuate(state, command(0.0, math.atan(2.7 * curvature)))
        angle = 4.0 * 0.2 * step * curvature
        circle = torch.tensor([math.sin(angle) / curvature, (1 - math.cos(angle)) / curvature])
        torch.testing.assert_close(state.position[0, 0], circle, atol=1e-3, rtol=0)
        assert float(state.curvature) == pytest.approx(curvature, rel=1e-5)


def test_straight_braking_ends_at_rest() -> None:
    car, state = Bicycle(AT_ONCE, 0.2), one(3.0)
    for _ in range(6):
        state = car.actuate(state, command(-4.0, 0.0))
    assert float(state.position[0, 0, 0]) == pytest.approx(3.0**2 / (2 * 4.0), abs=1e-4)
    assert float(state.speed) == float(state.accel) == 0.0


def test_actuators_lag() -> None:
    car = Bicycle(replace(AT_ONCE, accel_time_constant_s=0.4, steer_rate_max_degps=10.0), 0.2)
    state = car.actuate(one(3.0), command(1.0, 0.3))
    assert float(state.accel) == pytest.approx(1 - math.exp(-0.5), rel=1e-5)
    assert float(torch.atan(2.7 * state.curvature)) == pytest.approx(math.radians(2.0), rel=1e-4)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_command_acts_exactly_so_many_steps_later(steps: int) -> None:
    late, prompt = Bicycle(replace(AT_ONCE, actuation_delay_s=0.2 * steps), 0.2), Bicycle(AT_ONCE, 0.2)
    state, queue = one(3.0), torch.zeros(1, steps, 1, 2)
    wanted = one(3.4, 0.05)
    for _ in range(steps):
        state, _, queue = late.move(state, wanted, queue)
        assert float(state.speed) == 3.0
        assert float(state.yaw) == 0.0
    first = prompt.command(one(3.0), wanted)
    torch.testing.assert_close(queue[:, 0], first)
    state, _, _ = late.move(state, wanted, queue)
    torch.testing.assert_close(state.speed, prompt.actuate(one(3.0), first).speed)


def test_without_lags_it_stays_near_its_plan(config: RunConfig) -> None:
    game = build_game(replace(config, dynamics=AT_ONCE))
    world = game.simulator.reset(draw_tasks(config, 4))
    for _ in range(45):
        wanted = game.plan(game.perceive(world), torch.zeros(4, 2)).state
        world, _ = game.simulator.step(world, wanted)
        if world.has_collided.any():  # head on
            break
        assert float((world.vehicles.position - wanted.position).norm(dim=-1).max()) < 0.03
    assert world.step.min() > 10


def test_a_late_noisy_episode_stays_finite() -> None:
    c = compose_config(["dynamics=bicycle", "dynamics.actuation_delay_s=0.2", "perception=noisy"])
    game = build_game(c)
    world = game.simulator.reset(draw_tasks(c, 2))
    assert world.command_queue.shape == (2, 1, 2, 2)
    for _ in range(c.scenario.episode_steps):
        wanted = game.plan(game.perceive(world), torch.tensor([[6.0, 2.0]] * 2)).state
        world, _ = game.simulator.step(world, wanted)
        assert world.vehicles.position.isfinite().all()
        assert (world.vehicles.speed >= 0).all()
    assert not game.simulator.reset(draw_tasks(c, 2)).command_queue.any()


def test_gains_act() -> None:
    wanted = replace(one(3.2), position=torch.tensor([[[0.9, 0.2]]]), yaw=torch.full((1, 1), 0.1))
    base = Bicycle(AT_ONCE, 0.2).command(one(3.0), wanted)
    for gain, column in (
        ("position_gain_1ps2", 0),
        ("lateral_gain_1pm2", 1),
    ):
        more = Bicycle(replace(AT_ONCE, **{gain: 2 * getattr(AT_ONCE, gain)}), 0.2).command(one(3.0), wanted)
        assert float(more[0, 0, column]) > float(base[0, 0, column]) > 0


def test_a_car_that_lost_its_plan_plans_anew_from_where_it_is() -> None:
    queue = torch.zeros(1, 0, 1, 2)
    for away, is_lost in ((0.5, False), (1.5, True)):
        wanted = replace(one(0.0), position=torch.tensor([[[away, 0.0]]]))
        moved, reference, _ = Bicycle(replace(AT_ONCE, position_gain_1ps2=0.0), 0.2).move(one(0.0), wanted, queue)
        assert torch.equal(reference.position, moved.position if is_lost else wanted.position)
