"""Streets whose width changes: kerbs, parked cars and room beside the routes; what cannot be is refused."""

import math

import pytest
import torch
from composed import compose_config

from negopipe.errors import UserError
from negopipe.simulation.build_road import build_road, draw_streets
from negopipe.simulation.geometry import boxes_from_pose
from negopipe.simulation.one_street import OneStreet
from negopipe.simulation.road import Road


def changes(*each: tuple[object, object, object]) -> str:
    """Override with changes of (start_m, length_m, width_m), intervals as lists."""
    items = ",".join(f"{{start_m:{start},length_m:{length},width_m:{width}}}" for start, length, width in each)
    return f"scenario.road.width_changes=[{items}]"


def road_of(*overrides: str) -> Road:
    return build_road(compose_config(list(overrides)).scenario)


def kerbs(road: Road, *sigma: float) -> list[list[float]]:
    at = torch.tensor(sigma)
    return [side.tolist() for side in road.kerbs_at(at, torch.ones_like(at))]


def test_kerbs_follow_the_changes_along_the_egos_way() -> None:
    road = road_of(changes((-50.0, 10.0, 9.0), (-30.0, 10.0, 7.0), (20.0, 5.0, 6.0)), "scenario.road.width_m=8.0")
    expected = [4.0, 4.0, 4.25, 4.5, 4.5, 4.0, 3.5, 3.5, 3.25, 3.0, 3.0]
    places = (-90.0, -50.0, -45.0, -40.0, -30.0, -25.0, -20.0, 20.0, 22.5, 25.0, 80.0)
    assert kerbs(road, *places) == [pytest.approx(expected, abs=1e-5)] * 2


@pytest.mark.parametrize("scenario", ["narrow_lane", "bent_street"])
def test_a_change_moves_no_route_and_no_car(scenario: str) -> None:
    """Routes as without it to the tables' 0.02 mm; a footprint beside the old kerb is off the road no longer."""
    narrow = road_of(f"scenario={scenario}")
    wide = road_of(f"scenario={scenario}", changes((20.0, 5.0, 9.0)))
    assert isinstance(narrow, OneStreet)
    s, direction = torch.linspace(-40, 60, 301), torch.ones(301)
    for way in (direction, -direction):
        for a, b in zip(narrow.route_offset(s, way), wide.route_offset(s, way), strict=True):
            torch.testing.assert_close(a, b, atol=2e-5, rtol=0)
    torch.testing.assert_close(narrow.parked, wide.parked, atol=1e-5, rtol=0)
    sigma = torch.tensor([0.0, 30.0])
    line = narrow.line(torch.ones(2))
    x, y = line.place(sigma, torch.full((2,), 3.2))
    boxes = boxes_from_pose(x, y, line.heading(sigma).expand(2), 4.5, 1.8)
    assert narrow.is_off_road(boxes, torch.ones(2)).tolist() == [True, True]
    assert wide.is_off_road(boxes, torch.ones(2)).tolist() == [True, False]


def test_cars_stand_at_the_kerb_of_their_corridor() -> None:
    """Cars on one side leave the gap to the other kerb, where the road is 7 m wide and where it is 6 m wide."""
    road = road_of(
        "scenario.road.n_corridors=2",
        "scenario.road.parked_sides=left",
        "scenario.road.swerve_length_m=20.0",
        "scenario.road.lane_offset_m=1.5",
        "scenario.road.between_corridors_m=50.0",
        changes((-10.0, 20.0, 6.0)),
    )
    cars = torch.tensor(road.parked_on_line[0])
    inner = cars[:, 1] - cars[:, 3] / 2
    assert inner[cars[:, 0] < 0].tolist() == pytest.approx([-3.5 + 3.2] * 3)
    assert inner[cars[:, 0] > 0].tolist() == pytest.approx([-3.0 + 3.2] * 3)
    middles = torch.tensor([6.0, 68.0])  # of both corridors
    d, _, _ = road.route_offset(middles, torch.ones(2))
    assert d.tolist() == pytest.approx([-3.5 + 1.6, -3.0 + 1.6], abs=1e-5)


def test_every_size_of_a_change_is_drawn() -> None:
    config = compose_config(
        ["scenario.streets.n_training=30", changes(([20.0, 30.0], [5.0, 10.0], [6.2, 9.0])), "curriculum=mixture"]
    )
    assert config.scenario.has_many_streets
    for name, low, high in (("start_m", 20.0, 30.0), ("length_m", 5.0, 10.0), ("width_m", 6.2, 9.0)):
        drawn = [getattr(street.width_changes[0], name) for street in draw_streets(config.scenario)]
        assert low <= min(drawn) < (low + high) / 2 < max(drawn) <= high


def test_drawn_streets_keep_room_beside_their_routes() -> None:
    """A lane of 1.75 m + half a vehicle + clearance_m = 0.3 m needs a road of 5.9 m; narrower ones are drawn again."""
    few = ["scenario.streets.n_training=30", "curriculum=mixture"]
    streets = draw_streets(compose_config([*few, changes((25.0, 8.0, [4.0, 9.0]))]).scenario)
    assert min(street.width_changes[0].width_m for street in streets) >= 2 * (1.75 + 0.9 + 0.3) - 0.02
    assert math.isclose(max(street.reach_m for street in streets), 33.0)


@pytest.mark.parametrize(
    ("override", "line"),
    [
        (changes((20.0, 10.0, 5.0)), "scenario.road.width_changes must leave streets.clearance_m = 0.3 and curvatu"),
        (changes((0.0, 10.0, 9.0)), "width_changes must lie outside the corridor -6 to 6, got 0 to 10 by start_m"),
        (changes((-90.0, 190.0, 9.0)), "width_changes must lie outside the corridor -6 to 6, got -90 to 100"),
        (changes((30.0, 10.0, 9.0), (35.0, 10.0, 7.0)), "width_changes must follow one another, the one before ends"),
        (changes((195.0, 10.0, 9.0)), "width_changes must lie within 200 m from the corridor, got 195 to 205 by"),
        (changes((20.0, 0.0, 9.0)), "scenario.road.width_changes.0.length_m must be greater than 0, got 0"),
        (changes((20.0, 10.0, -1.0)), "scenario.road.width_changes.0.width_m must be greater than 0, got -1"),
        (changes((20.0, 10.0, [9.0, 7.0])), "scenario.road.width_changes.0.width_m must be [low, high] with low"),
        (changes((-40.0, 10.0, 5.0)), "width_m of at least 7 with parked_sides both, got 5"),
        (changes((20.0, 10.0, [3.0, 4.0])), "scenario.road must leave streets with streets.clearance_m = 0.3 and curv"),
        (
            "scenario.road.width_changes=[{start_m:20.0,length_m:5.0}]",
            "scenario.road.width_changes.0.width_m is missing",
        ),
        ("scenario.road.width_changes=[9.0]", "scenario.road.width_changes.0 must be"),
    ],
)
def test_widths_that_cannot_be_are_refused_in_one_line(override: str, line: str) -> None:
    with pytest.raises(UserError) as raised:
        compose_config(["scenario.streets.n_training=2", override])
    assert line in str(raised.value)
    assert "\n" not in str(raised.value)
