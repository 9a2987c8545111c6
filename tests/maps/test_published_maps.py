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
from negopipe.maps.street import to_line

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


def test_karlsruhes_kerbs_agree_with_its_lanelets(karlsruhe: MapStreet) -> None:
    """Every point of the kerbs lies on a border of a two-way lanelet, by borders straight from the file."""
    root = ElementTree.parse(published(KARLSRUHE)).getroot()
    nodes = {n.get("id"): (float(n.get("lat") or ""), float(n.get("lon") or "")) for n in root.findall("node")}
    ways = {w.get("id"): [nodes[nd.get("ref")] for nd in w.findall("nd")] for w in root.findall("way")}
    borders = []
    for relation in root.findall("relation"):
        tags = {t.get("k"): t.get("v") for t in relation.findall("tag")}
        if tags.get("type") == "lanelet" and tags.get("one_way") == "no" and tags.get("subtype") == "road":
            borders += [np.array(ways[m.get("ref")]) for m in relation.findall("member") if m.get("type") == "way"]
    middle = np.round(np.median(list(nodes.values()), axis=0), 2)
    radius = np.array([6367449.0, 6378137.0 * np.cos(np.radians(middle[0]))])
    near = [(np.radians(border - middle) * radius)[:, ::-1] for border in borders]
    offsets = [
        min(distance_to(border, point[None])[0] for border in near) for k in kerbs(karlsruhe) for point in k[::8]
    ]
    # the plane of degrees used here differs from the projection by its scale: 0.3 % of the distance from the origin
    assert max(offsets) < 0.05 + 0.005 * np.abs(karlsruhe.points).max()


def test_starnberg_whole_is_longer_and_has_tight_bends() -> None:
    street = read_commonroad(published(STARNBERG), ids=(), parking=PARKING, rows=())
    assert_is_sound(street)
    assert 285 < street.length_m < 300
    assert 0.1 < np.abs(street.curvature).max() < 0.2


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
