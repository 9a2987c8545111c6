"""The road by hand; world <-> route frame is exact both ways."""

import math
from dataclasses import asdict
from typing import Any

import pytest
import torch
from pydantic import ValidationError

from negopipe.config.root import RunConfig
from negopipe.game.game import Game
from negopipe.simulation.geometry import Boxes, boxes_from_pose, overlap_depth
from negopipe.simulation.one_street import OneStreet
from negopipe.simulation.road import RouteState
from negopipe.simulation.road_config import RoadConfig
from negopipe.simulation.state import VehicleState

LEFT_BEND = [{"start_m": -26.2, "length_m": 52.4, "angle_deg": 40.0}]  # radius 40 m at the tightest
SHARP_S = [
    {"start_m": -30.0, "length_m": 33.0, "angle_deg": 50.0},  # 20 m
    {"start_m": 3.0, "length_m": 30.0, "angle_deg": -45.0},
]
bent = pytest.mark.parametrize("bends", [LEFT_BEND, SHARP_S], ids=["left", "s"])


def road_with(config: RunConfig, **changes: Any) -> OneStreet:
    return OneStreet(RoadConfig(**(asdict(config.scenario.road) | changes)).street)


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
    # drive a circle for a moment: d' and d'' must be those of the curve that is really driven
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
    d_pprime = (after.d_prime - before.d_prime) / (after.s - before.s)
    assert float(d_pprime) == pytest.approx(float(now.d_pprime), rel=1e-5)


def test_route_is_own_lane_corridor_own_lane(config: RunConfig, game: Game) -> None:
    size = config.scenario.road
    s = torch.tensor([-30.0, 0.0, size.corridor_length_m / 2, size.corridor_length_m, 60.0])
    d, d_prime, d_pprime = game.simulator.road.route_offset(s, torch.ones(()))
    lane = -size.lane_offset_m
    torch.testing.assert_close(d, torch.tensor([lane, 0.0, 0.0, 0.0, lane]))
    assert float(d_prime.abs().max()) < 1e-6
    assert float(d_pprime.abs().max()) < 1e-6


def test_parked_cars_leave_the_corridor(config: RunConfig, game: Game) -> None:
    size, cars = config.scenario.road, game.simulator.road.parked_cars
    assert len(cars) == 2 * size.n_parked_per_side
    inner = cars[:, 1].abs() - cars[:, 4] / 2
    torch.testing.assert_close(2 * inner, torch.full_like(inner, size.corridor_gap_m))
    ends = cars[:, 0].abs() + cars[:, 3] / 2
    assert float(ends.max()) == pytest.approx(size.corridor_length_m / 2)
    assert float((cars[:, 1].abs() + cars[:, 4] / 2).max()) <= size.width_m / 2 + 1e-6


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"corridor_gap_m": 4.0}, "need a width_m of at least 7.8 with parked_sides both, got 7.0"),
        ({"parked_sides": "left", "corridor_gap_m": 5.2}, "width_m of at least 7.1 with parked_sides left, got 7.0"),
        ({"n_parked_per_side": 4}, "n_parked_per_side 4 cars of 3.6 m do not fit into corridor_length_m 12.0"),
        ({"bends": [{"start_m": 0.0, "length_m": 5.0, "angle_deg": 60.0}]}, "a radius of at least width_m 7, got"),
        ({"bends": [{"start_m": 0.0, "length_m": 0.0, "angle_deg": 60.0}]}, "length_m"),
    ],
)
def test_what_does_not_fit_is_refused(config: RunConfig, change: dict, line: str) -> None:
    with pytest.raises(ValidationError, match=line):
        road_with(config, **change)


def test_arrival_is_beyond_the_corridor(config: RunConfig) -> None:
    road = OneStreet(config.scenario.road.street)
    assert road.target_s_m == config.scenario.road.corridor_length_m + config.scenario.road.target_distance_m


def test_where_only_one_side_is_parked(config: RunConfig) -> None:
    for side, free_kerb in (("left", -1.0), ("right", 1.0)):
        road = road_with(config, parked_sides=side)
        cars, size = road.parked_boxes(), road.config
        assert len(road.parked_cars) == size.n_parked_per_side
        assert torch.equal(torch.sign(cars.y), torch.full_like(cars.y, -free_kerb))
        # a box from the free kerb that is as wide as the gap touches nothing, a hair wider one does
        for width, is_touching in ((size.corridor_gap_m - 0.01, False), (size.corridor_gap_m + 0.01, True)):
            middle = torch.tensor(free_kerb * (size.width_m - width) / 2)
            gap = boxes_from_pose(torch.zeros(()), middle, torch.zeros(()), size.corridor_length_m, width)
            assert bool((overlap_depth(gap, cars) > 0).any()) == is_touching


@pytest.mark.parametrize("side", ["left", "right"])
def test_both_directions_drive_through_the_middle_of_the_gap(config: RunConfig, side: str) -> None:
    road = road_with(config, parked_sides=side)
    direction = torch.tensor([1.0, -1.0])
    size = road.config
    middle = (-1 if side == "left" else 1) * (size.width_m - size.corridor_gap_m) / 2
    d, d_prime, d_pprime = road.route_offset(torch.full((2,), size.corridor_length_m / 3), direction)
    assert (direction * d).tolist() == pytest.approx([middle] * 2)
    assert float(d_prime.abs().max() + d_pprime.abs().max()) == 0
    d, _, _ = road.route_offset(torch.tensor([-30.0, -30.0]), direction)
    assert d.tolist() == pytest.approx([-size.lane_offset_m] * 2)


@pytest.mark.parametrize("side", ["both", "left", "right"])
def test_route_derivatives(config: RunConfig, side: str) -> None:
    # 3e-5: the third derivative jumps where the swerve begins and ends, by some 0.4 / m2, seen over a step of 1e-4 m
    road, step = road_with(config, parked_sides=side), 1e-4
    s = torch.linspace(-20, 35, 551, dtype=torch.float64)[:, None]
    direction = torch.tensor([1.0, -1.0], dtype=torch.float64)
    (d0, d_prime0, _), (_, d_prime, d_pprime), (d1, d_prime1, _) = (
        road.route_offset(at, direction) for at in (s - step, s, s + step)
    )
    torch.testing.assert_close((d1 - d0) / (2 * step), d_prime.expand_as(d1), atol=1e-5, rtol=0)
    torch.testing.assert_close((d_prime1 - d_prime0) / (2 * step), d_pprime.expand_as(d_prime1), atol=3e-5, rtol=0)


def on_bent_road(road: OneStreet, n: int, dtype: torch.dtype) -> tuple[VehicleState, torch.Tensor]:
    """Vehicles of both directions anywhere on the road, headings within 0.6 rad of it."""
    vehicles, direction = random_vehicles(n)
    sigma, d = vehicles.position.unbind(-1)
    position = torch.stack(road.reference.place(2 * sigma, d), -1)
    yaw = vehicles.yaw + road.reference.heading(2 * sigma)
    fields = (position, yaw, vehicles.speed, vehicles.accel, vehicles.curvature)
    return VehicleState(*(field.to(dtype) for field in fields)), direction.to(dtype)


@bent
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 2e-4)])
def test_round_trip_on_a_bent_road(config: RunConfig, bends: list, dtype: torch.dtype, tolerance: float) -> None:
    # float32: a position is known to 4e-6 m, and the curvature's 2nd derivative (some 0.03 / m2) makes little of it;
    # accelerations carry the roundings of speed squared, times 36
    road = road_with(config, bends=bends)
    vehicles, direction = on_bent_road(road, 500, dtype)
    route = road.to_route(vehicles, direction)
    assert torch.equal(route.s, road.progress(vehicles.position, direction))
    back = road.to_world(route, direction)
    torch.testing.assert_close(back.position, vehicles.position, atol=min(tolerance, 1e-4), rtol=0)
    torch.testing.assert_close(torch.sin(back.yaw), torch.sin(vehicles.yaw), atol=tolerance, rtol=0)
    torch.testing.assert_close(torch.cos(back.yaw), torch.cos(vehicles.yaw), atol=tolerance, rtol=0)
    for name in ("speed", "accel", "curvature"):
        torch.testing.assert_close(getattr(back, name), getattr(vehicles, name), atol=tolerance, rtol=0)


@bent
@pytest.mark.parametrize("towards", [1.0, -1.0])
@pytest.mark.parametrize("side", ["both", "left"])
def test_a_drive_on_a_bent_road_is_one_motion(config: RunConfig, bends: list, towards: float, side: str) -> None:
    # along its route at s(t) = -40 + 3 t + 0.2 t^2: yaw, speed, acceleration and curvature in the world frame must
    # be those of the positions driven. 1e-4: error ~ step^2; 5e-4: third derivatives jump at a bend's and a
    # swerve's ends, by some 0.4 / m2, seen over a step of 6 mm
    road, step = road_with(config, bends=bends, parked_sides=side), 1e-3
    direction = torch.tensor(towards, dtype=torch.float64)

    def at(t: torch.Tensor) -> VehicleState:
        s = -40 + 3 * t + 0.2 * t**2
        route = RouteState(s, 3 + 0.4 * t, torch.full_like(t, 0.4), *road.route_offset(s, direction))
        return road.to_world(route, direction)

    t = torch.linspace(0, 15, 1501, dtype=torch.float64)
    before, now, after = at(t - step), at(t), at(t + step)
    velocity = (after.position - before.position) / (2 * step)
    along = torch.stack([torch.cos(now.yaw), torch.sin(now.yaw)], -1)
    torch.testing.assert_close(velocity, now.speed[:, None] * along, atol=1e-4, rtol=0)
    torch.testing.assert_close((after.speed - before.speed) / (2 * step), now.accel, atol=5e-4, rtol=0)
    turned = torch.sin(after.yaw - before.yaw) / (2 * step)
    torch.testing.assert_close(turned, now.speed * now.curvature, atol=5e-4, rtol=0)


def test_both_directions_see_a_mirrored_road(config: RunConfig) -> None:
    # a bend to the left that is symmetric about the corridor is one to the right for the opposite direction
    road = road_with(config, bends=LEFT_BEND)
    s, direction = torch.tensor([[-10.0], [0.0], [6.0]]), torch.tensor([1.0, -1.0])
    kappa, kappa_prime = road.curvature(s, direction)
    assert float(kappa[2, 0]) == pytest.approx(1 / 40, rel=0.01)
    torch.testing.assert_close(kappa[:, 0], -kappa[:, 1])
    torch.testing.assert_close(kappa_prime[:, 0], -kappa_prime[:, 1])
    d = torch.tensor(-1.75)
    ahead, against = (
        road.to_world(RouteState(s[:, 0], *torch.ones(2, 1), d.expand(3), *torch.zeros(2, 3)), v) for v in direction
    )
    there = road.reference.project(*ahead.position.unbind(-1))
    back = road.reference.project(*against.position.unbind(-1))
    torch.testing.assert_close(there[0], -back[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(there[1], -back[1], atol=1e-5, rtol=0)


def test_parked_cars_stand_along_the_bend(config: RunConfig) -> None:
    road = road_with(config, bends=LEFT_BEND)
    parked = torch.tensor(road.parked_on_line[0])
    sigma, d, length, width = parked.unbind(-1)
    straight = OneStreet(config.scenario.road.street)
    torch.testing.assert_close(parked, straight.parked_cars[:, [0, 1, 3, 4]])
    x, y, yaw, _, _ = road.parked_cars.unbind(-1)
    torch.testing.assert_close(torch.stack(road.reference.project(x, y)), torch.stack([sigma, d]), atol=1e-5, rtol=0)
    torch.testing.assert_close(yaw, road.reference.heading(sigma))
    assert (length.tolist(), width.tolist()) == ([pytest.approx(3.6)] * 6, [pytest.approx(1.9)] * 6)


@pytest.mark.parametrize("bends", [[], LEFT_BEND, SHARP_S], ids=["straight", "left", "s"])
def test_off_road_is_where_the_footprint_crosses_a_kerb(config: RunConfig, bends: list) -> None:
    # against many points on the footprint's rim; between the points tested a chord of 2.25 m across an inner kerb
    # of radius 16.5 m hides up to 4 cm
    road = road_with(config, bends=bends)
    vehicles, _ = on_bent_road(road, 500, torch.float32)
    x, y = vehicles.position.unbind(-1)
    boxes = boxes_from_pose(x, y, vehicles.yaw, 4.5, 1.8)
    share = torch.linspace(-1, 1, 41)
    u = torch.cat([2.25 * share, 2.25 * share, torch.full((41,), 2.25), torch.full((41,), -2.25)])
    v = torch.cat([torch.full((41,), 0.9), torch.full((41,), -0.9), 0.9 * share, 0.9 * share])
    rim_x = x[..., None] + u * boxes.cos[..., None] - v * boxes.sin[..., None]
    rim_y = y[..., None] + u * boxes.sin[..., None] + v * boxes.cos[..., None]
    beyond = road.reference.project(rim_x, rim_y)[1].abs().amax(-1) - road.config.width_m / 2
    is_off_road = road.is_off_road(boxes)
    assert is_off_road[beyond > 0.04].all()
    assert not is_off_road[beyond < -1e-4].any()
    assert 25 < int(is_off_road.sum()) < 475


def is_covered(boxes: Boxes, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    point = Boxes(x[:, None], y[:, None], torch.ones(1), torch.zeros(1), 0.0, 0.0)
    return (overlap_depth(point, boxes) > 0).any(-1)


@pytest.mark.parametrize(
    "bends",
    [
        [],
        LEFT_BEND,
        SHARP_S,
        [{"start_m": 10.0, "length_m": 58.9, "angle_deg": -90.0}],
        [{"start_m": start, "length_m": 60.0, "angle_deg": 50.0} for start in (-60.0, 20.0)],
    ],
    ids=["straight", "left", "s", "quarter", "two"],
)
def test_off_road_boxes_cover_what_lies_beyond_the_kerbs(config: RunConfig, bends: list) -> None:
    # 3 cm: a strip's edge is straight, the kerb is not (roadside.SAGITTA_M)
    road = road_with(config, bends=bends)
    generator = torch.Generator().manual_seed(0)
    sigma = 160 * torch.rand(20000, generator=generator) - 80
    d = 18 * torch.rand(20000, generator=generator) - 9
    x, y = road.reference.place(sigma, d)
    beyond = d.abs() - road.config.width_m / 2
    boxes = road.off_road_boxes()
    covered = is_covered(boxes, x, y)
    assert covered[beyond > 0.035].all()
    assert not covered[beyond < -1e-3].any()
    assert boxes.x.numel() == 2 if not bends else boxes.x.numel() < 120


@bent
def test_a_view_ahead_out_of_the_bend_is_covered_too(config: RunConfig, bends: list) -> None:
    # all that a grid 50 m ahead and 6.3 m to each side shows from the road
    road = road_with(config, bends=bends)
    generator = torch.Generator().manual_seed(0)
    for direction in (1.0, -1.0):
        sigma, u, v, offset = torch.rand(4, 20000, generator=generator)
        sigma, u, v = 70 * sigma - 45, 55 * u - 5, 12.6 * v - 6.3
        line_x, line_y, heading = road.reference.pose(direction * sigma)
        heading = heading + (1 - direction) * math.pi / 2
        v = v - 1.75 * offset
        x = line_x + u * torch.cos(heading) - v * torch.sin(heading)
        y = line_y + u * torch.sin(heading) + v * torch.cos(heading)
        beyond = road.reference.project(x, y)[1].abs() - road.config.width_m / 2
        covered = is_covered(road.off_road_boxes(), x, y)
        assert covered[beyond > 0.035].all()
        assert not covered[beyond < -1e-3].any()


def test_kerbs_are_half_a_width_from_the_line(config: RunConfig) -> None:
    road = road_with(config, bends=SHARP_S)
    right, left = road.kerb_lines(road.sampled(-50.0, 50.0), torch.tensor(1.0))
    for kerb, d in ((right, -3.5), (left, 3.5)):
        offset = road.reference.project(*kerb.unbind(-1))[1]
        torch.testing.assert_close(offset, torch.full_like(offset, d), atol=1e-4, rtol=0)
    assert float(road.progress(right[-1], torch.tensor(1.0))) == pytest.approx(56.0, abs=1e-4)


@pytest.mark.slow
def test_a_bent_road_compiles_into_one_graph(config: RunConfig) -> None:
    road = road_with(config, bends=SHARP_S)
    vehicles, direction = on_bent_road(road, 8, torch.float32)

    def there_and_back(vehicles: VehicleState, direction: torch.Tensor) -> VehicleState:
        return road.to_world(road.to_route(vehicles, direction), direction)

    compiled = torch.compile(there_and_back, backend="eager", fullgraph=True)(vehicles, direction)
    torch.testing.assert_close(compiled.position, there_and_back(vehicles, direction).position)
