"""The frame of a map's street, its free sides, and the fit of its line."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_maps import HALF_M, PARKING, kerb, middle, two_way_map
from map_measures import assert_is_sound, distance_to, kerbs

from negopipe.maps import KerbsideRow, MapStreet, Side, free_sides, read_lanelet2
from negopipe.maps.boxes import corners, overlap
from negopipe.maps.line import integrate
from negopipe.maps.street import to_line, to_plane


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> MapStreet:
    osm, _ = two_way_map()
    path = osm.write(tmp_path_factory.mktemp("maps") / "drawn.osm")
    return read_lanelet2(path, ids=(), parking=PARKING, rows=())


def test_a_drawn_street_has_its_middle_and_its_kerbs(street: MapStreet) -> None:
    assert_is_sound(street)
    along = np.linspace(0, 120, 2000)
    assert distance_to(middle(along), street.points).max() < 0.05
    assert np.abs(street.left_m + street.right_m - 2 * HALF_M).max() < 0.02
    for line, side in zip(kerbs(street), (1, -1), strict=True):
        assert distance_to(kerb(along, side), line).max() < 0.02


def test_a_street_lies_within_its_length(street: MapStreet) -> None:
    along = np.linspace(0, 120, 5000)
    length = np.linalg.norm(np.diff(middle(along), axis=0), axis=1).sum()
    assert length - 1.5 < street.length_m <= length


def test_plane_and_line_are_inverse(street: MapStreet) -> None:
    random = np.random.default_rng(0)
    sigma, d = random.uniform(1, street.length_m - 1, 500), random.uniform(-5, 5, 500)
    again = to_line(street, to_plane(street, sigma, d)[0])
    assert np.abs(again[0] - sigma).max() < 1e-3
    assert np.abs(again[1] - d).max() < 1e-3


def test_an_integrated_arc_is_a_circle() -> None:
    line = integrate(np.array([1.0, 2.0, 0.0]), np.full(100, 0.1))
    assert np.abs(np.linalg.norm(line.points - [1.0, 12.0], axis=1) - 10).max() < 1e-6
    assert np.linalg.norm(line.points[50] - [1 + 10 * np.sin(2.5), 12 - 10 * np.cos(2.5)]) < 1e-6


def test_free_sides_end_at_the_parked_vehicles(street: MapStreet) -> None:
    parked = np.array([[40.0, 2.0, 0.0, 4.0, 1.8], [60.0, -2.5, np.pi / 2, 4.0, 1.8]])
    left, right = free_sides(replace(street, parked=parked))
    beside = np.abs(street.sigma - 40) < 2
    assert left[beside] == pytest.approx(1.1)
    assert (left[np.abs(street.sigma - 40) > 3] == street.left_m[np.abs(street.sigma - 40) > 3]).all()
    assert right[np.abs(street.sigma - 60) < 0.9] == pytest.approx(0.5)


def test_overlap_of_rectangles_touching_crossing_and_apart() -> None:
    places = np.array([[0.0, 0.0], [4.0, 0.0], [3.9, 0.0], [0.0, 1.9], [3.2, 3.0]])
    headings = np.array([0.0, 0.0, 0.0, np.pi / 2, 0.8])
    shapes = corners(places, headings, np.tile([4.0, 2.0], (5, 1)))
    assert overlap(shapes[0], shapes[1:]).tolist() == [False, True, True, False]


def test_rows_along_the_kerb(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = two_way_map()[0].write(tmp_path_factory.mktemp("maps") / "rows.osm")
    rows = [KerbsideRow(Side.LEFT, 20.0, 60.0, 0.2), KerbsideRow(Side.RIGHT, 70.0, 100.0, 0.3)]
    street = read_lanelet2(path, ids=(), parking=PARKING, rows=rows)
    assert_is_sound(street)
    sigma, d, yaw, length, width = street.parked.T
    assert ((d > 0) == (sigma < 65)).all()
    assert len(sigma) >= 10
    assert (yaw == 0).all()
    ends = sigma + np.stack([-length, length]) / 2
    assert ends[:, d > 0].min() >= 20
    assert ends[:, d > 0].max() <= 60
    gaps = np.interp(sigma, street.sigma, street.left_m)[d > 0] - (d + width / 2)[d > 0]
    assert 0.2 - 1e-6 < gaps.min() <= gaps.max() < 0.25
    half = replace(PARKING, fill=0.5)
    fewer = read_lanelet2(path, ids=(), parking=half, rows=rows[:1]).parked
    assert len(fewer) == round(0.5 * (d > 0).sum())
    other = read_lanelet2(path, ids=(), parking=replace(half, seed=4), rows=rows[:1]).parked
    assert fewer.tolist() != other.tolist()
