"""Constant velocity along the other vehicle's route, seen from the viewer."""

import math

import pytest
import torch

from negopipe.config import RunConfig
from negopipe.env import Game
from negopipe.planner.prediction import PredictedPath, predict
from negopipe.simulation.state import VehicleState


def roll_out(
    config: RunConfig, game: Game, x: float, y: float, yaw: float, speed: float, viewer: float
) -> PredictedPath:
    yaw_, speed_, zero = (torch.tensor([value]) for value in (yaw, speed, 0.0))
    vehicle = VehicleState(torch.tensor([[x, y]]), yaw_, speed_, zero, zero)
    times = torch.tensor([1.0, 2.0, 4.0])
    road = game.simulator.road
    path = predict(config.planner.prediction, road, vehicle, torch.tensor([viewer]), times)
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
