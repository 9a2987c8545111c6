"""Limits of a step, and the reachable sets of others: exact cases."""

from dataclasses import replace

import pytest
import torch
from games import draw_tasks, tiny_config
from torch import Tensor

from negopipe.game.game import build_game
from negopipe.safety.config import AssumedConfig, MotionLimitConfig
from negopipe.safety.limits import is_drivable, is_finite
from negopipe.safety.reach import farthest, nearest, until_rest
from negopipe.simulation.state import EGO, VehicleState
from negopipe.tensors.tree import map_tensors

LIMITS = MotionLimitConfig(7.0, 2.4, 8.0, 6.0, 0.25, 0.3)
ASSUMED = AssumedConfig(7.0, 2.4, 8.0, 0.5, 4.0, 8.0)
DT_S = 0.2


def state(x: float, speed: float, curvature: float = 0.0, yaw: float = 0.0, y: float = 0.0) -> VehicleState:
    values = [torch.tensor([value]) for value in (yaw, speed, 0.0, curvature)]
    return VehicleState(torch.tensor([[x, y]]), *values)


@pytest.mark.parametrize(
    ("after", "is_ok"),
    [
        (state(1.0, 5.0), True),
        (state(1.048, 5.48), True),  # full acceleration
        (state(0.84, 3.4), True),  # full braking
        (state(1.1, 6.0), False),  # faster than the acceleration allows
        (state(0.7, 2.0), False),  # slower than the brakes allow
        (state(1.5, 5.0), False),  # too far
        (state(1.0, 5.0, y=0.5), False),  # sideways
        (state(1.0, 5.0, curvature=0.3), False),  # too sharp
        (state(1.0, 5.0, curvature=0.245), False),  # too sharp for its speed
        (state(1.0, 5.0, yaw=1.0), False),  # turned on the spot
    ],
)
def test_a_step_is_driven_only_within_the_limits(after: VehicleState, is_ok: bool) -> None:
    assert is_drivable(LIMITS, state(0.0, 5.0), after, DT_S).tolist() == [is_ok]


def test_nobody_drives_faster_than_the_highest_speed() -> None:
    assert is_drivable(LIMITS, state(0.0, 7.0), state(1.4, 7.0), DT_S).all()
    assert not is_drivable(LIMITS, state(0.0, 7.0), state(1.44, 7.4), DT_S).any()


@pytest.mark.parametrize("field", ["position", "yaw", "speed", "accel", "curvature"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_state_is_finite_in_every_field(field: str, value: float) -> None:
    spoilt: Tensor = torch.full_like(getattr(state(0.0, 1.0), field), value)
    assert is_finite(state(0.0, 1.0)).all()
    assert not is_finite(replace(state(0.0, 1.0), **{field: spoilt})).any()


def test_the_planner_keeps_the_limits() -> None:
    config = tiny_config("mixture")
    game = build_game(config)
    world = game.simulator.reset(draw_tasks(config, 16))
    for _ in range(25):
        motion = game.plan(game.perceive(world), world.horizons(2.0))
        before, after = (map_tensors(lambda field: field[:, EGO], each) for each in (world.reference, motion.state))
        assert is_drivable(LIMITS, before, after, DT_S).all()
        world, _ = game.step(world, motion)


@pytest.mark.parametrize("speed", [0.0, 3.0, 6.5, 8.0])
def test_distances_are_those_of_driving_at_the_limits(speed: float) -> None:
    n, h = 30_000, 1e-4
    v, far, near, braked = speed, 0.0, 0.0, speed
    for _ in range(n):
        gained = min(v + ASSUMED.accel_max_mps2 * h, max(v, ASSUMED.speed_max_mps))
        far, v = far + (v + gained) / 2 * h, gained
        less = max(braked - ASSUMED.decel_max_mps2 * h, 0.0)
        near, braked = near + (braked + less) / 2 * h, less
    now = torch.tensor([speed])
    assert float(farthest(ASSUMED, now, torch.tensor(n * h))) == pytest.approx(far, abs=1e-3)
    assert float(nearest(ASSUMED, now, torch.tensor(n * h))) == pytest.approx(near, abs=1e-3)


def test_who_responds_late_comes_to_rest_after_the_distance_of_rss() -> None:
    then = 5.0 + 2.4 * 0.5
    expected = 5.0 * 0.5 + 2.4 * 0.5**2 / 2 + then**2 / (2 * 4.0)
    assert float(until_rest(ASSUMED, torch.tensor(5.0))) == pytest.approx(expected, abs=1e-5)


def test_who_drives_backwards_may_go_on_so() -> None:
    assert float(nearest(ASSUMED, torch.tensor(-1.5), torch.tensor(2.0))) == pytest.approx(-3.0)
