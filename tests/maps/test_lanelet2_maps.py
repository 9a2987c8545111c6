"""Lanelet2 maps read: two-way and opposing lanelets, nodes in metres and degrees, parking areas, errors of one line."""

import math
from pathlib import Path

import numpy as np
import pytest
from drawn_maps import (
    HALF_M,
    PARKING,
    Lanelet2Map,
    degrees_instead,
    kerb,
    middle,
    opposing_map,
    two_way_map,
)
from map_measures import assert_is_sound, distance_to, kerbs

from negopipe.errors import UserError
from negopipe.maps import MapStreet, Parking, read_lanelet2
from negopipe.maps.projection import project


def read(path: Path, *ids: int, parking: Parking = PARKING) -> MapStreet:
    return read_lanelet2(path, ids=ids, parking=parking, rows=())


def assert_is_the_drawn_one(street: MapStreet, length_m: float = 120) -> None:
    assert_is_sound(street)
    along = np.linspace(0, length_m, 1000)
    for side, line in zip((1, -1), kerbs(street), strict=True):
        assert min(distance_to(kerb(along, s), line).max() for s in (side, -side)) < 0.02


@pytest.mark.parametrize("keeps_right", [True, False])
def test_opposing_lanelets_make_a_street(tmp_path: Path, keeps_right: bool) -> None:
    osm, ids = opposing_map(keeps_right=keeps_right)
    path = osm.write(tmp_path / "drawn.osm")
    assert_is_the_drawn_one(read(path))
    assert_is_the_drawn_one(read(path, ids[0], ids[2]))


def test_ids_choose_the_part_and_its_direction(tmp_path: Path) -> None:
    osm, ids = two_way_map(length_m=150)
    path = osm.write(tmp_path / "drawn.osm")
    whole, ahead, back = read(path), read(path, ids[1], ids[2]), read(path, ids[2], ids[1])
    assert 2 / 3 * whole.length_m - 1.5 < ahead.length_m < 2 / 3 * whole.length_m + 1.5
    assert np.linalg.norm(ahead.points[0] - middle(np.array([50.0]))[0]) < 0.6
    assert np.linalg.norm(back.points[-1] - middle(np.array([50.0]))[0]) < 0.6
    assert math.cos(back.heading[0] - ahead.heading[-1]) < -0.99


def test_the_longest_street_goes_straight_on_at_a_side_street(tmp_path: Path) -> None:
    osm, _ = two_way_map()
    begin, end = kerb(np.array([80.0]), 1)[0], kerb(np.array([80.0]), -1)[0]
    ahead = np.array([0.3, 1.0]) * np.linspace(0, 90, 10)[:, None]
    osm.lanelet(osm.way(begin + ahead), osm.way(end + ahead), one_way="no")
    assert_is_the_drawn_one(read(osm.write(tmp_path / "drawn.osm")))


def test_degrees_give_the_street_of_metres(tmp_path: Path) -> None:
    radius_m, latitude = 6378137.0, 49.0036
    osm, _ = two_way_map()
    metres = read(osm.write(tmp_path / "metres.osm"))
    e2 = 0.00669437999014
    w = 1 - e2 * math.sin(math.radians(latitude)) ** 2
    north, east = radius_m * (1 - e2) / w**1.5, radius_m / math.sqrt(w) * math.cos(math.radians(latitude))
    degrees_instead(osm, lambda x, y: (latitude + math.degrees(y / north), 8.4242 + math.degrees(x / east)))
    degrees = read(osm.write(tmp_path / "degrees.osm"))
    assert_is_sound(degrees)
    assert abs(degrees.length_m - metres.length_m) <= 0.5
    count = min(len(degrees.left_m), len(metres.left_m))
    assert np.abs(degrees.curvature[:count] - metres.curvature[:count]).max() < 1e-3
    assert np.abs(degrees.left_m[:count] - metres.left_m[:count]).max() < 0.01


def test_the_projection_agrees_with_utm() -> None:
    """Two places by UTM zone 32 (scale 0.9996, central meridian 9 degrees) as pyproj 3.7.2 gives them."""
    ours = project(np.array([49.0135, 48.0]), np.array([8.4044, 10.5]), (0.0, 9.0)) * 0.9996
    theirs = np.array([[456448.195860, 5429127.391172], [611891.934952, 5317388.798879]]) - [500000, 0]
    assert np.abs(ours - theirs).max() < 1e-3


def test_parking_areas_hold_vehicles_along_and_across(tmp_path: Path) -> None:
    osm, _ = two_way_map()
    shallow, deep, far = (np.linspace(*interval, 8) for interval in ((20, 50), (60, 80), (90, 110)))
    osm.parking(np.concatenate([kerb(shallow, 1, HALF_M), kerb(shallow, 1, HALF_M + 2.2)[::-1]]))
    osm.parking(np.concatenate([kerb(deep, -1, HALF_M), kerb(deep, -1, HALF_M + 5)[::-1]]))
    osm.parking(np.concatenate([kerb(far, 1, HALF_M + 3), kerb(far, 1, HALF_M + 6)[::-1]]))
    path = osm.write(tmp_path / "drawn.osm")
    street = read(path)
    assert_is_sound(street)
    sigma, d, yaw, length, width = street.parked.T
    along, across = d > 0, d < 0
    assert along.sum() >= 4
    assert across.sum() >= 6
    assert np.abs(yaw[along]).max() < 0.05
    assert np.abs(np.abs(yaw[across]) - np.pi / 2).max() < 0.05
    assert (d - width / 2)[along].min() > HALF_M - 0.06
    assert (d + width / 2)[along].max() < HALF_M + 2.26
    assert (d - length / 2)[across].min() > -HALF_M - 5.06
    assert (d + length / 2)[across].max() < -HALF_M + 0.06
    assert sigma[along].max() < sigma[across].min()
    assert len(read(path, parking=Parking(0.0, 1, (3.9, 4.9), (1.7, 1.9), (0.6, 1.2))).parked) == 0


def test_name_source_and_licence_stand_beside_the_map(tmp_path: Path) -> None:
    path = two_way_map()[0].write(tmp_path / "drawn.osm")
    street = read(path)
    assert (street.name, street.source, street.licence) == ("drawn", "", "")
    (tmp_path / "SOURCE").write_text("drawn by a test\nsecond line\n")
    (tmp_path / "LICENSE").write_text("Public domain\n")
    street = read(path)
    assert (street.name, street.source, street.licence) == ("drawn", "drawn by a test", "Public domain")


def _broken(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "broken.osm"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("no map at all", "is not XML"),
        ("<gpx/>", "its root is <gpx>; a lanelet2 map (OSM XML) has <osm>"),
        ("<osm/>", "has no lanelets of subtype road or play_street"),
        ('<osm><node id="1" lat="x" lon="8"/></osm>', "lat of a node is 'x'; a finite number is allowed"),
        ('<osm><node id="1" lat="95" lon="8"/></osm>', "lat of a node is 95; -90 < lat < 90 is allowed"),
        ('<osm><way id="a"/></osm>', "the id of a way is 'a'; a whole number is allowed"),
    ],
)
def test_a_file_that_is_no_map(tmp_path: Path, text: str, line: str) -> None:
    assert line in error_of(_broken(tmp_path, text))


def error_of(path: Path, *ids: int) -> str:
    """The one line of the error, which names the file."""
    with pytest.raises(UserError) as caught:
        read(path, *ids)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message


def test_a_missing_file(tmp_path: Path) -> None:
    assert "cannot be read (No such file or directory); a lanelet2 map (OSM XML) is needed" in error_of(
        tmp_path / "no.osm"
    )


def test_one_way_roads_are_no_street(tmp_path: Path) -> None:
    osm = Lanelet2Map()
    along = np.linspace(0, 100, 40)
    osm.lanelet(osm.way(kerb(along, 1)), osm.way(kerb(along, -1)), one_way="yes")
    assert "has no two-way street" in error_of(osm.write(tmp_path / "one_way.osm"))


def test_ids_that_are_not_there_or_not_one_street(tmp_path: Path) -> None:
    osm, ids = two_way_map()
    path = osm.write(tmp_path / "drawn.osm")
    allowed = ", ".join(str(i) for i in sorted(ids))
    assert f"lanelet 7000 is not one that both directions use; {allowed} are allowed" in error_of(path, 7000)
    assert "do not follow one another" in error_of(path, ids[0], ids[2])


def test_a_street_too_short(tmp_path: Path) -> None:
    path = two_way_map(length_m=30)[0].write(tmp_path / "short.osm")
    assert "m long; at least 40 m is needed" in error_of(path)


def test_a_street_with_a_bend_too_tight(tmp_path: Path) -> None:
    osm = Lanelet2Map()
    corner = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 60.0]])
    wide = 5 * np.array([[0, 1], [-1, 1], [-1, 0]])
    osm.lanelet(osm.way(corner + wide), osm.way(corner - wide), one_way="no")
    path = osm.write(tmp_path / "corner.osm")
    ids = [int(r.get("id", "")) for r in osm.root.findall("relation")]
    message = error_of(path, *ids)
    assert "too tight for it; 1 - curvature * d must stay above 0.2 on the road" in message


def test_a_border_without_its_nodes(tmp_path: Path) -> None:
    osm, _ = two_way_map()
    osm.root.remove(osm.root.findall("node")[3])
    assert "is missing or lacks nodes" in error_of(osm.write(tmp_path / "torn.osm"))
