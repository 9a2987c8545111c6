"""Bays: rows of cars beside a drawn road, seen but in nobody's way; what cannot be is refused."""

import pytest
import torch
from composed import compose_config

from negopipe.errors import UserError
from negopipe.simulation.build_road import build_road, draw_streets
from negopipe.simulation.one_street import OneStreet

ALONG = "{side:left,start_m:-30.0,length_m:12.0,kerb_gap_m:0.5,is_across:false,n_parked:3}"
ACROSS = "{side:right,start_m:20.0,length_m:10.0,kerb_gap_m:0.0,is_across:true,n_parked:4}"


def bays(*each: str) -> str:
    return f"scenario.road.bays=[{','.join(each)}]"


def test_cars_in_bays_stand_behind_the_kerb_and_fill_their_row() -> None:
    road = build_road(compose_config([bays(ALONG, ACROSS)]).scenario)
    boxes = road.parked_boxes()
    lengths, widths = 2 * torch.as_tensor(boxes.half_length), 2 * torch.as_tensor(boxes.half_width)
    assert boxes.x[-7:].tolist() == pytest.approx([-28.2, -24.0, -19.8, 20.95, 23.65, 26.35, 29.05], abs=1e-5)
    assert boxes.y[-7:].tolist() == pytest.approx([3.5 + 0.5 + 0.95] * 3 + [-3.5 - 1.8] * 4, abs=1e-5)
    assert lengths[-7:].tolist() == pytest.approx([3.6] * 3 + [1.9] * 4)
    assert widths[-7:].tolist() == pytest.approx([1.9] * 3 + [3.6] * 4)


def test_bays_change_no_route_no_narrow_place_and_no_plan() -> None:
    plain, road = (build_road(compose_config(each).scenario) for each in ([], [bays(ALONG, ACROSS)]))
    assert isinstance(plain, OneStreet)
    s, ways = torch.linspace(-40, 60, 301), torch.ones(301)
    for a, b in zip(plain.route_offset(s, ways), road.route_offset(s, ways), strict=True):
        torch.testing.assert_close(a, b, atol=2e-5, rtol=0)
    torch.testing.assert_close(plain.narrow_places, road.narrow_places)
    assert len(plain.parked_on_line[0]) == len(road.parked_on_line[0]) == 6


def test_a_bay_stands_behind_the_kerb_where_the_road_is_widest() -> None:
    change = "scenario.road.width_changes=[{start_m:20.0,length_m:4.0,width_m:9.0}]"
    boxes = build_road(compose_config([bays(ACROSS), change]).scenario).parked_boxes()
    assert boxes.y[-4:].tolist() == pytest.approx([-4.5 - 1.8] * 4, abs=1e-5)


def test_every_size_of_a_bay_is_drawn() -> None:
    bay = "{side:left,start_m:[-40.0,-30.0],length_m:[12.0,16.0],kerb_gap_m:[0.0,1.0],is_across:false,n_parked:[1,3]}"
    scenario = compose_config([bays(bay), "scenario.streets.n_training=20", "curriculum=mixture"]).scenario
    drawn = [street.bays[0] for street in draw_streets(scenario)]
    for name, low, high in (("start_m", -40, -30), ("length_m", 12, 16), ("kerb_gap_m", 0, 1), ("n_parked", 1, 3)):
        values = {getattr(each, name) for each in drawn}
        assert len(values) > 2
        assert all(low <= value <= high for value in values)
    assert scenario.most_parked == 6 + 3


@pytest.mark.parametrize(
    ("each", "line"),
    [
        (
            (ALONG.replace("12.0", "10.0"),),
            "bays must be as long as their cars, got n_parked 3 of 3.6 m along the road",
        ),
        ((ALONG, ALONG.replace("-30.0", "-20.0")), "one on the left ends at -18 by start_m and length_m, got another"),
        ((ALONG.replace("left", "both"),), "scenario.road.bays.0.side"),
    ],
)
def test_bays_that_do_not_fit_are_refused_in_one_line(each: tuple[str, ...], line: str) -> None:
    with pytest.raises(UserError) as raised:
        compose_config([bays(*each)])
    assert line in str(raised.value)
    assert "\n" not in str(raised.value)
