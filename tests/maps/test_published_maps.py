"""Published maps at hand: the streets of Karlsruhe, Starnberg and CommonRoad's overtaking road."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from drawn_maps import PARKING, published
from map_measures import Array, assert_is_sound, distance_to, kerbs

from negopipe.errors import UserError
from negopipe.maps import KerbsideRow, MapStreet, Side, free_sides, read_commonroad, read_lanelet2
from negopipe.maps.boxes import corners_of_parked
from negopipe.maps.projection import project
from negopipe.maps.street import to_line, to_plane

KARLSRUHE = "karlsruhe/mapping_example.osm"
STARNBERG = "starnberg/DEU_Starnberg-1_1_T-1.xml"
OVER = "over/ZAM_Over-1_1.xml"
GENTLE = (13, 80, 27)
"""Lanelets of Starnberg's street before its tight bends."""


@pytest.fixture(scope="module")
def karlsruhe() -> MapStreet:
    return read_lanelet2(published(KARLSRUHE), ids=(), parking=PARKING, rows=())


def commonroad_bounds(path: Path, chain: list[tuple[int, int]]) -> tuple[Array, Array]:
    """Outer bounds of pairs of opposing lanelets, left and right, straight from the file."""
    bounds = {}
    for lane in ElementTree.parse(path).getroot().findall("lanelet"):
        points = [[float(p.findtext(a) or "") for a in "xy"] for p in lane.findall("rightBound/point")]
        bounds[int(lane.get("id") or "")] = np.array(points)
    left = np.concatenate([bounds[against][::-1] for _, against in chain])
    return left, np.concatenate([bounds[ahead] for ahead, _ in chain])


def test_karlsruhe_is_as_long_and_wide_as_its_lanelets(karlsruhe: MapStreet) -> None:
    assert_is_sound(karlsruhe)
    width = karlsruhe.left_m + karlsruhe.right_m
    assert 200 < karlsruhe.length_m < 210
    assert 5.4 < width.min() < 5.7
    assert 8 < width.max() < 9.5
    assert np.abs(karlsruhe.left_m - karlsruhe.right_m).max() < 0.6


def test_karlsruhes_parking_areas_hold_vehicles_beside_the_road(karlsruhe: MapStreet) -> None:
    """Thirteen areas, seven on one side and six on the other, in runs that gaps of more than 2 m part."""
    sigma, d = karlsruhe.parked[:, :2].T
    assert 50 < len(sigma) < 75
    assert min((d > 0).sum(), (d < 0).sum()) > 10
    corners = to_line(karlsruhe, corners_of_parked(karlsruhe).reshape(-1, 2))
    kerb = np.where(
        corners[1] > 0,
        np.interp(corners[0], karlsruhe.sigma, karlsruhe.left_m),
        np.interp(corners[0], karlsruhe.sigma, karlsruhe.right_m),
    )
    assert (kerb - np.abs(corners[1])).max() < 0.25
    left, right = free_sides(karlsruhe)
    assert 5.3 < (left + right).min() < 5.7


def test_rows_make_karlsruhe_narrow() -> None:
    row = KerbsideRow(Side.LEFT, 60.0, 90.0, 0.2)
    street = read_lanelet2(published(KARLSRUHE), ids=(), parking=PARKING, rows=(row,))
    assert_is_sound(street)
    left, right = free_sides(street)
    narrow = left + right < 4.2
    assert 60 <= street.sigma[narrow].min() < street.sigma[narrow].max() <= 90


@pytest.mark.parametrize(
    ("name", "ids", "chain", "length_m", "width_m"),
    [
        (STARNBERG, GENTLE, [(13, 12), (80, 94), (27, 26)], (225, 235), 7.0),
        (OVER, (1000,), [(1000, 1001)], (198, 201), 6.5),
    ],
)
def test_kerbs_agree_with_the_lanelets_bounds(
    name: str, ids: tuple[int, ...], chain: list[tuple[int, int]], length_m: tuple[float, float], width_m: float
) -> None:
    path = published(name)
    street = read_commonroad(path, ids=ids, parking=PARKING, rows=())
    assert_is_sound(street)
    assert length_m[0] < street.length_m < length_m[1]
    assert np.abs(street.left_m + street.right_m - width_m).max() < 0.1
    for kerb, bound in zip(kerbs(street), commonroad_bounds(path, chain), strict=True):
        assert distance_to(bound, kerb).max() < 0.05
        inside = to_line(street, bound)[0]
        within = (inside > 0.5) & (inside < street.length_m - 0.5)
        assert distance_to(kerb, bound[within]).max() < 0.05


def karlsruhes_borders() -> list[Array]:
    """Borders of Karlsruhe's two-way lanelets, straight from the file, projected."""
    root = ElementTree.parse(published(KARLSRUHE)).getroot()
    degrees = np.array([[float(n.get("lat") or ""), float(n.get("lon") or "")] for n in root.findall("node")])
    latitude, longitude = np.round(np.median(degrees, axis=0), 2)
    places = project(*degrees.T, (float(latitude), float(longitude)))
    nodes = dict(zip([n.get("id") for n in root.findall("node")], places, strict=True))
    ways = {w.get("id"): np.array([nodes[nd.get("ref")] for nd in w.findall("nd")]) for w in root.findall("way")}
    borders = []
    for relation in root.findall("relation"):
        tags = {t.get("k"): t.get("v") for t in relation.findall("tag")}
        if (tags.get("type"), tags.get("subtype"), tags.get("one_way")) == ("lanelet", "road", "no"):
            borders += [ways[member.get("ref")] for member in relation.findall("member")]
    return borders


def test_karlsruhes_kerbs_agree_with_its_lanelets(karlsruhe: MapStreet) -> None:
    borders = karlsruhes_borders()
    for kerb in kerbs(karlsruhe):
        assert np.min([distance_to(border, kerb) for border in borders], axis=0).max() < 0.05
    vertices = np.concatenate(borders)
    sigma, d = to_line(karlsruhe, vertices)
    beside = vertices[(sigma > 5) & (sigma < 130) & (np.abs(d) < 6)]  # roads cross before and come in behind
    assert len(beside) > 50
    assert np.min([distance_to(kerb, beside) for kerb in kerbs(karlsruhe)], axis=0).max() < 0.05


def test_starnberg_whole_is_longer_and_has_tight_bends() -> None:
    street = read_commonroad(published(STARNBERG), ids=(), parking=PARKING, rows=())
    assert_is_sound(street)
    assert 285 < street.length_m < 300
    assert 0.1 < np.abs(street.curvature).max() < 0.2
    random = np.random.default_rng(0)
    sigma, d = random.uniform(0, street.length_m, 2000), random.uniform(-3, 3, 2000)
    again = to_line(street, to_plane(street, sigma, d)[0])
    assert np.abs(again[0] - sigma).max() < 1e-3
    assert np.abs(again[1] - d).max() < 1e-3


def test_over_has_one_vehicle_that_stands_on_the_road() -> None:
    street = read_commonroad(published(OVER), ids=(), parking=PARKING, rows=())
    assert len(street.parked) == 1
    left, right = free_sides(street)
    assert 3.0 < (left + right).min() < 3.3


def test_an_id_of_a_one_way_lanelet_of_karlsruhe_is_not_found() -> None:
    with pytest.raises(
        UserError, match=r"lanelet 1 is not one that both directions use; 42973, .*lanelets\) are allowed"
    ):
        read_lanelet2(published(KARLSRUHE), ids=(1,), parking=PARKING, rows=())
