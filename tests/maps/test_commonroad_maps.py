"""CommonRoad scenarios read: opposing and two-way lanelets, static obstacles of every shape, errors of one line."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from drawn_maps import (
    HALF_M,
    PARKING,
    add_obstacle,
    bidirectional_map,
    commonroad_map,
    kerb,
    middle,
    written,
)
from map_measures import assert_is_sound, distance_to, kerbs

from negopipe.errors import UserError
from negopipe.maps import KerbsideRow, MapStreet, Side, free_sides, read_commonroad

BOX = "<rectangle><length>4.4</length><width>1.8</width></rectangle>"


def read(path: Path, *ids: int, rows: tuple[KerbsideRow, ...] = ()) -> MapStreet:
    return read_commonroad(path, ids=ids, parking=PARKING, rows=rows)


@pytest.mark.parametrize("root", [commonroad_map(), commonroad_map(side="Right"), bidirectional_map()])
def test_the_drawn_street_has_its_kerbs(tmp_path: Path, root: ElementTree.Element) -> None:
    street = read(written(root, tmp_path / "drawn.xml"))
    assert_is_sound(street)
    along = np.linspace(0, 120, 1000)
    for side, line in zip((1, -1), kerbs(street), strict=True):
        assert distance_to(kerb(along, side), line).max() < 0.02
    assert street.name == root.get("benchmarkID")


def test_ids_choose_the_part_and_its_direction(tmp_path: Path) -> None:
    path = written(commonroad_map(length_m=200), tmp_path / "drawn.xml")
    whole, first, back = read(path), read(path, 1), read(path, 12, 11)
    assert abs(first.length_m - whole.length_m / 2) < 1.5
    assert np.linalg.norm(back.points[0] - whole.points[-1]) < 0.6
    assert np.linalg.norm(back.points[-1] - whole.points[0]) < 0.6


@pytest.mark.parametrize("version", ["2020a", "2018b"])
@pytest.mark.parametrize(
    ("shape", "moved", "turned", "size"),
    [
        (BOX, (0.0, 0.0), 0.0, (4.4, 1.8)),
        (BOX.replace("</width>", "</width><orientation>0.1</orientation>"), (0.0, 0.0), 0.1, (4.4, 1.8)),
        (BOX.replace("</width>", "</width><center><x>1.0</x><y>0.5</y></center>"), (1.0, 0.5), 0.0, (4.4, 1.8)),
        ("<circle><radius>0.75</radius></circle>", (0.0, 0.0), 0.0, (1.5, 1.5)),
        (
            "<polygon><point><x>-2</x><y>-1</y></point><point><x>2</x><y>-1</y></point>"
            "<point><x>0</x><y>0.5</y></point></polygon>",
            (0.0, -0.25),
            0.0,
            (4.0, 1.5),
        ),
        (BOX + "<circle><radius>1.0</radius></circle>", (0.0, 0.0), 0.0, (4.4, 2.0)),
    ],
)
def test_static_obstacles_become_parked_vehicles(
    tmp_path: Path,
    shape: str,
    moved: tuple[float, float],
    turned: float,
    size: tuple[float, float],
    version: str,
) -> None:
    root = commonroad_map()
    place = kerb(np.array([40.0]), 1, HALF_M - 1.2)[0]
    heading = float(np.arctan(6 / 25 * np.cos(40 / 25)))
    add_obstacle(root, place, heading, shape, version)
    add_obstacle(root, place + np.array([0.0, 40.0]), heading, shape, version)  # far from the street
    street = read(written(root, tmp_path / "drawn.xml"))
    assert len(street.parked) == 1
    sigma, d, yaw, length, width = street.parked[0]
    assert (length, width) == pytest.approx(size)
    assert yaw == pytest.approx(turned, abs=0.02)
    assert d == pytest.approx(HALF_M - 1.2 + moved[1], abs=0.05)
    ahead = np.linalg.norm(np.diff(middle(np.linspace(0, 40, 500)), axis=0), axis=1).sum()
    assert sigma == pytest.approx(ahead + moved[0], abs=0.6)


def test_rows_park_vehicles_where_the_file_has_none(tmp_path: Path) -> None:
    path = written(commonroad_map(), tmp_path / "drawn.xml")
    street = read(path, rows=(KerbsideRow(Side.RIGHT, 30.0, 70.0, 0.2),))
    assert_is_sound(street)
    assert len(street.parked) >= 6
    left, right = free_sides(street)
    narrow = right < HALF_M - 1
    assert 30 <= street.sigma[narrow].min() < street.sigma[narrow].max() <= 70
    assert (left + right).min() == pytest.approx(2 * HALF_M - 0.2 - street.parked[:, 4].max(), abs=0.1)


def test_a_row_leaves_out_the_places_of_obstacles(tmp_path: Path) -> None:
    root = commonroad_map()
    row = (KerbsideRow(Side.RIGHT, 30.0, 70.0, 0.2),)
    alone = read(written(root, tmp_path / "row.xml"), rows=row).parked
    add_obstacle(root, kerb(np.array([48.0]), -1, HALF_M - 1)[0], 0.0, "<circle><radius>0.8</radius></circle>")
    street = read(written(root, tmp_path / "both.xml"), rows=row)
    assert_is_sound(street)
    assert len(alone) - 2 <= len(street.parked) - 1 < len(alone)
    assert (street.parked[:, 3].round(6) == 1.6).sum() == 1


def error_of(path: Path, *ids: int, rows: tuple[KerbsideRow, ...] = ()) -> str:
    """The one line of the error, which names the file."""
    with pytest.raises(UserError) as caught:
        read(path, *ids, rows=rows)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("{}", "is not XML"),
        ("<osm/>", "its root is <osm>; a CommonRoad scenario (XML) has <commonRoad>"),
        ("<commonRoad/>", "has no lanelets; a CommonRoad scenario with roads is needed"),
        ('<commonRoad><lanelet id="5"/></commonRoad>', "lanelet 5 has a bound of less than two points"),
    ],
)
def test_a_file_that_is_no_scenario(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "broken.xml"
    path.write_text(text)
    assert line in error_of(path)


def test_roads_of_one_direction_are_no_street(tmp_path: Path) -> None:
    root = commonroad_map()
    for lane in root.findall("lanelet"):
        lane.remove(next(child for child in lane if child.tag == "adjacentLeft"))
    assert "has no two-way street" in error_of(written(root, tmp_path / "one_way.xml"))


def test_ids_that_are_not_there(tmp_path: Path) -> None:
    path = written(commonroad_map(), tmp_path / "drawn.xml")
    assert "lanelet 7 is not one that both directions use; 1, 2, 11, 12 are allowed" in error_of(path, 7)


def test_a_street_too_short(tmp_path: Path) -> None:
    assert "at least 40 m is needed" in error_of(written(commonroad_map(length_m=30), tmp_path / "short.xml"))


def test_a_row_outside_the_street(tmp_path: Path) -> None:
    path = written(commonroad_map(), tmp_path / "drawn.xml")
    message = error_of(path, rows=(KerbsideRow(Side.LEFT, 20.0, 500.0, 0.2),))
    assert "a row of parked vehicles reaches from 20 to 500 m; from < to <=" in message


@pytest.mark.parametrize(
    ("shape", "line"),
    [
        ("", "has no shape"),
        ("<ellipse/>", "is a ellipse; rectangles, circles and polygons are allowed"),
        ("<circle><radius>wide</radius></circle>", "is 'wide'; a finite number is allowed"),
        ("<polygon/>", "has a polygon of 0 points"),
    ],
)
def test_an_obstacle_without_a_usable_shape(tmp_path: Path, shape: str, line: str) -> None:
    root = commonroad_map()
    add_obstacle(root, middle(np.array([20.0]))[0], 0.0, shape)
    assert line in error_of(written(root, tmp_path / "shape.xml"))


def test_an_obstacle_without_an_exact_place(tmp_path: Path) -> None:
    root = commonroad_map()
    add_obstacle(root, middle(np.array([20.0]))[0], 0.0, BOX)
    position = root[-1].find("initialState/position")
    assert position is not None
    position.clear()
    assert "is not one point; exact positions are allowed" in error_of(written(root, tmp_path / "place.xml"))
