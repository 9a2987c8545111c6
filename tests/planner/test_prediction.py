"""Constant velocity or acceleration along the other vehicle's route, seen from the viewer."""

import math

import pytest
import torch
from composed import compose_config
from situations import CAR

from negopipe.config.root import RunConfig
from negopipe.game.game import Game
from negopipe.planner.prediction import ConstantAccelerationConfig, PredictedPath, predict
from negopipe.planner.situation import Others
from negopipe.simulation.road import RouteState
from negopipe.simulation.state import VehicleState


def roll_out(
    config: RunConfig, game: Game, x: float, y: float, yaw: float, speed: float, viewer: float
) -> PredictedPath:
    yaw_, speed_, zero = (torch.tensor([value]) for value in (yaw, speed, 0.0))
    vehicle = VehicleState(torch.tensor([[x, y]]), yaw_, speed_, zero, zero)
    times = torch.tensor([1.0, 2.0, 4.0])
    road = game.simulator.road
    direction = torch.tensor([viewer])
    others = Others.of(road, vehicle, direction, torch.ones(1, 1, dtype=torch.bool), CAR)
    path = predict(config.planner.prediction, road, others, direction, times)
    return PredictedPath(*(field[:, 0] for field in path))


def test_oncoming_vehicle_drives_towards_the_viewer(config: RunConfig, game: Game) -> None:
    path = roll_out(config, game, 30.0, 1.75, math.pi, 5.0, viewer=1.0)
    length = config.scenario.road.corridor_length_m
    assert path.s.tolist() == pytest.approx([30 + length / 2 - 5 * t for t in (1, 2, 4)], abs=1e-4)
    # own lane first (to the viewer's left), the middle line once it is in the corridor
    assert path.d.tolist()[:2] == pytest.approx([1.75, 1.75], abs=1e-3)
    in_corridor = roll_out(config, game, 14.0, 1.75, math.pi, 5.0, viewer=1.0)
    assert abs(float(in_corridor.d[-1])) < 0.05


def test_both_viewers_see_the_same_place(config: RunConfig, game: Game) -> None:
    ahead, against = (roll_out(config, game, 10.0, 1.2, math.pi + 0.1, 3.0, viewer=v) for v in (1.0, -1.0))
    length = config.scenario.road.corridor_length_m
    torch.testing.assert_close(ahead.s, length - against.s)
    torch.testing.assert_close(ahead.d, -against.d)


def test_standing_vehicle_stays(config: RunConfig, game: Game) -> None:
    path = roll_out(config, game, 10.0, 2.4, math.pi, 0.0, viewer=-1.0)
    assert path.s.tolist() == pytest.approx([config.scenario.road.corridor_length_m / 2 - 10.0] * 3)
    assert path.d.tolist() == pytest.approx([-2.4] * 3)


def test_offset_fades_with_the_distance_driven(config: RunConfig, game: Game) -> None:
    path = roll_out(config, game, 100.0, 2.25, math.pi, 5.0, viewer=-1.0)
    decay = config.planner.prediction.offset_decay_m
    expected = [-1.75 - 0.5 * math.exp(-5 * t / decay) for t in (1, 2, 4)]
    assert path.d.tolist() == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("speed", "accel", "travelled"),
    [
        # at rest after 2 / 4 = 0.5 s and 2^2 / (2 * 4) = 0.5 m
        (2.0, -4.0, [0.46875, 0.5, 0.5, 0.5]),
        # 1 s of braking, 5 - 2 / 2 = 4 m, then 3 m/s
        (5.0, -2.0, [1.734375, 4.0, 7.0, 13.0]),
        # at 6 m/s after 0.5 s and 2.75 m
        (5.0, 2.0, [2.015625, 5.75, 11.75, 23.75]),
        # faster already: not slowed down
        (7.0, 2.0, [2.625, 7.0, 14.0, 28.0]),
        # from rest: 1 m in the first second, then 2 m/s
        (0.0, 2.0, [0.140625, 1.0, 3.0, 7.0]),
        (0.0, -3.0, [0.0, 0.0, 0.0, 0.0]),
        (4.0, 0.0, [1.5, 4.0, 8.0, 16.0]),
    ],
)
def test_constant_acceleration_by_hand(speed: float, accel: float, travelled: list[float]) -> None:
    config = ConstantAccelerationConfig("constant_acceleration", offset_decay_m=5.0, hold_s=1.0, speed_max_mps=6.0)
    zero = torch.zeros(1)
    now = RouteState(zero, zero + speed, zero + accel, zero, zero, zero)
    got = config.travelled(now, torch.tensor([0.375, 1.0, 2.0, 4.0]))
    assert got[:, 0].tolist() == pytest.approx(travelled, abs=1e-5)


def test_the_model_is_a_group_of_its_own() -> None:
    assert compose_config().planner.prediction.kind == "constant_velocity"
    chosen = compose_config(["planner/prediction=constant_acceleration"]).planner.prediction
    assert chosen == ConstantAccelerationConfig("constant_acceleration", 5.0, 1.0, 6.0)
