"""The road by hand; world <-> route frame is exact both ways."""

import math

import pytest
import torch
from pydantic import ValidationError

from negopipe.config import RunConfig
from negopipe.env import Game
from negopipe.simulation.road import Road, RoadConfig
from negopipe.simulation.state import VehicleState


def random_vehicles(n: int) -> tuple[VehicleState, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(n, 2, generator=generator, dtype=torch.float64)

    direction = torch.tensor([1.0, -1.0], dtype=torch.float64).expand(n, 2)
    yaw = uniform(-0.6, 0.6) + (1 - direction) * (math.pi / 2)
    position = torch.stack([uniform(-30, 30), uniform(-3, 3)], -1)
    return VehicleState(position, yaw, uniform(0, 6), uniform(-4, 2), uniform(-0.2, 0.2)), direction


def test_round_trip(game: Game) -> None:
    vehicles, direction = random_vehicles(200)
    road = game.simulator.road
    back = road.to_world(road.to_route(vehicles, direction), direction)
    torch.testing.assert_close(back.position, vehicles.position)
    torch.testing.assert_close(torch.sin(back.yaw), torch.sin(vehicles.yaw))
    torch.testing.assert_close(torch.cos(back.yaw), torch.cos(vehicles.yaw))
    for name in ("speed", "accel", "curvature"):
        torch.testing.assert_close(getattr(back, name), getattr(vehicles, name))


def test_route_derivatives_are_those_of_the_motion(game: Game) -> None:
    # drive a circle for a moment: d' and d'' must be the slope and bend of the curve that is really driven
    road, speed, curvature = game.simulator.road, 4.0, 0.1

    def at(t: float) -> VehicleState:
        yaw = 0.2 + speed * curvature * t
        x = (math.sin(yaw) - math.sin(0.2)) / curvature
        y = (math.cos(0.2) - math.cos(yaw)) / curvature
        fields = ([[x, y]], [yaw], [speed], [0.0], [curvature])
        return VehicleState(*(torch.tensor(f, dtype=torch.float64) for f in fields))

    ahead = torch.ones(1, dtype=torch.float64)
    before, now, after = (road.to_route(at(t), ahead) for t in (-1e-3, 0.0, 1e-3))
    assert float((after.s - before.s) / 2e-3) == pytest.approx(float(now.s_dot), rel=1e-6)
    assert float((after.s_dot - before.s_dot) / 2e-3) == pytest.approx(float(now.s_ddot), rel=1e-5)
    assert float((after.d - before.d) / (after.s - before.s)) == pytest.approx(float(now.d_prime), rel=1e-5)
    bend = (after.d_prime - before.d_prime) / (after.s - before.s)
    assert float(bend) == pytest.approx(float(now.d_pprime), rel=1e-5)


def test_route_is_own_lane_corridor_own_lane(config: RunConfig, game: Game) -> None:
    size = config.scenario.road
    s = torch.tensor([-30.0, 0.0, size.corridor_length_m / 2, size.corridor_length_m, 60.0])
    d, slope, bend = game.simulator.road.route_offset(s)
    lane = -size.lane_offset_m
    torch.testing.assert_close(d, torch.tensor([lane, 0.0, 0.0, 0.0, lane]))
    assert float(slope.abs().max()) < 1e-6
    assert float(bend.abs().max()) < 1e-6


def test_parked_cars_leave_the_corridor(config: RunConfig, game: Game) -> None:
    size, cars = config.scenario.road, game.simulator.road.parked_cars
    assert len(cars) == 2 * size.n_parked_per_side
    inner = cars[:, 1].abs() - cars[:, 4] / 2
    torch.testing.assert_close(2 * inner, torch.full_like(inner, size.corridor_gap_m))
    ends = cars[:, 0].abs() + cars[:, 3] / 2
    assert float(ends.max()) == pytest.approx(size.corridor_length_m / 2)
    assert float((cars[:, 1].abs() + cars[:, 4] / 2).max()) <= size.width_m / 2 + 1e-6


@pytest.mark.parametrize("change", [{"corridor_gap_m": 4.0}, {"n_parked_per_side": 4}])
def test_cars_that_do_not_fit_are_refused(config: RunConfig, change: dict) -> None:
    from dataclasses import asdict

    with pytest.raises(ValidationError):
        RoadConfig(**(asdict(config.scenario.road) | change))


def test_arrival_is_beyond_the_corridor(config: RunConfig) -> None:
    road = Road(config.scenario.road)
    assert road.target_s_m == config.scenario.road.corridor_length_m + config.scenario.road.target_distance_m
