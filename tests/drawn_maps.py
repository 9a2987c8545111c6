"""Maps drawn for tests: a bent street of known kerbs as lanelet2 and as CommonRoad file, and published maps at hand."""

import os
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from negopipe.maps import Parking

Array = NDArray[np.float64]

HALF_M = 3.0
"""Distance of the kerbs from the middle of the drawn street."""
PARKING = Parking(fill=1.0, seed=3, length_m=(3.9, 4.9), width_m=(1.7, 1.9), gap_m=(0.6, 1.2))
PUBLISHED = os.environ.get("NEGOPIPE_MAPS", "")
"""Folder of published maps, which are not part of the repository; docs/scenarios.md says where they can be had."""


def published(name: str) -> Path:
    """A published map at hand; the test is skipped where it is not."""
    path = Path(PUBLISHED, name)
    if not path.exists():
        pytest.skip(f"NEGOPIPE_MAPS names no folder with the published map {name}")
    return path


def middle(along: Array) -> Array:
    """Middle of the drawn street, gently bent, at coordinates along the x axis, [N, 2]."""
    return np.stack([along, 6 * np.sin(along / 25)], axis=-1)


def kerb(along: Array, side: int, half_m: float = HALF_M) -> Array:
    """Kerb of the drawn street, [N, 2]; side 1 left, -1 right."""
    slope = 6 / 25 * np.cos(along / 25)
    normal = np.stack([-slope, np.ones_like(slope)], axis=-1) / np.sqrt(1 + slope**2)[:, None]
    return middle(along) + side * half_m * normal


class Lanelet2Map:
    """OSM file with nodes in local metres, built way by way."""

    def __init__(self) -> None:
        self.root = ElementTree.Element("osm", version="0.6")
        self.ids: dict[tuple[float, float], str] = {}
        self.count = 0

    def _new(self, tag: str, **attributes: str) -> ElementTree.Element:
        self.count += 1
        return ElementTree.SubElement(self.root, tag, id=str(self.count), **attributes)

    def _tag(self, element: ElementTree.Element, **tags: str) -> None:
        for key, value in tags.items():
            ElementTree.SubElement(element, "tag", k=key, v=value)

    def node(self, place: Array) -> str:
        key = (round(float(place[0]), 6), round(float(place[1]), 6))
        if key not in self.ids:
            node = self._new("node", lat="49.0", lon="8.4")
            self._tag(node, local_x=str(key[0]), local_y=str(key[1]))
            self.ids[key] = node.get("id", "")
        return self.ids[key]

    def way(self, line: Array) -> str:
        nodes = [self.node(place) for place in line]
        way = self._new("way")
        for node in nodes:
            ElementTree.SubElement(way, "nd", ref=node)
        return way.get("id", "")

    def relation(self, members: list[tuple[str, str]], **tags: str) -> int:
        relation = self._new("relation")
        for way, role in members:
            ElementTree.SubElement(relation, "member", type="way", ref=way, role=role)
        self._tag(relation, **tags)
        return int(relation.get("id", ""))

    def lanelet(self, left: str, right: str, one_way: str) -> int:
        return self.relation([(left, "left"), (right, "right")], type="lanelet", subtype="road", one_way=one_way)

    def parking(self, outline: Array) -> None:
        """Multipolygon of one way per edge, every other one backwards."""
        ring = np.concatenate([outline, outline[:1]])
        edges = [ring[n : n + 2] if n % 2 else ring[n : n + 2][::-1] for n in range(len(outline))]
        ways = [(self.way(edge), "outer") for edge in edges]
        self.relation(ways, type="multipolygon", subtype="parking")

    def write(self, path: Path) -> Path:
        ElementTree.ElementTree(self.root).write(path)
        return path


def two_way_map(length_m: float = 120, pieces: int = 3) -> tuple[Lanelet2Map, list[int]]:
    """Drawn street of lanelets that both directions share, every other one drawn backwards; ids in their order."""
    osm, ids = Lanelet2Map(), []
    ends = np.linspace(0, length_m, pieces + 1)
    for n in range(pieces):
        along = np.linspace(ends[n], ends[n + 1], 25)
        left, right = kerb(along, 1), kerb(along, -1)
        turned = (right[::-1], left) if n % 2 else (left, right)
        ids.append(osm.lanelet(*(osm.way(line) for line in turned), one_way="no"))
    return osm, ids


def opposing_map(length_m: float = 120, keeps_right: bool = True) -> tuple[Lanelet2Map, list[int]]:
    """Drawn street of two pieces, each of two one-way lanelets that share the border in the middle."""
    osm, ids = Lanelet2Map(), []
    for begin, end in ((0.0, length_m / 2), (length_m / 2, length_m)):
        along = np.linspace(begin, end, 40)
        left, between, right = (osm.way(line) for line in (kerb(along, 1), middle(along), kerb(along, -1)))
        borders = ((between, right), (between, left)) if keeps_right else ((left, between), (right, between))
        ids += [osm.lanelet(*pair, one_way="yes") for pair in borders]
    return osm, ids


def degrees_instead(osm: Lanelet2Map, to_degrees: Callable[[float, float], tuple[float, float]]) -> None:
    """Give the nodes latitude and longitude instead of metres."""
    for node in osm.root.findall("node"):
        x, y = (float(tag.get("v", "")) for tag in node.findall("tag"))
        latitude, longitude = to_degrees(x, y)
        node.set("lat", f"{latitude:.12f}")
        node.set("lon", f"{longitude:.12f}")
        for tag in node.findall("tag"):
            node.remove(tag)


def _points(parent: ElementTree.Element, line: Array) -> None:
    for place in line:
        point = ElementTree.SubElement(parent, "point")
        for axis, value in zip("xy", place, strict=True):
            ElementTree.SubElement(point, axis).text = repr(float(value))


def _lane(root: ElementTree.Element, name: int, bounds: tuple[Array, Array], links: dict[str, list[int]]) -> None:
    lane = ElementTree.SubElement(root, "lanelet", id=str(name))
    for tag, line in zip(("leftBound", "rightBound"), bounds, strict=True):
        _points(ElementTree.SubElement(lane, tag), line)
    for tag, names in links.items():
        for other in names:
            link = ElementTree.SubElement(lane, tag, ref=str(other))
            if tag.startswith("adjacent"):
                link.set("drivingDir", "opposite")


def commonroad_map(length_m: float = 120, side: str = "Left") -> ElementTree.Element:
    """Drawn street of lanelets 1 and 2 ahead and 11 and 12 against them; `side`: where the opposing lane lies."""
    root = ElementTree.Element("commonRoad", benchmarkID="ZAM_Drawn-1_1_T-1", commonRoadVersion="2020a")
    for n, begin in enumerate((0.0, length_m / 2), 1):
        along = np.linspace(begin, begin + length_m / 2, 40)
        inner = middle(along)
        mine, theirs = kerb(along, -1), kerb(along, 1)
        ahead = (inner, mine) if side == "Left" else (theirs, inner)
        against = (inner[::-1], theirs[::-1]) if side == "Left" else (mine[::-1], inner[::-1])
        neighbour = f"adjacent{side}"
        _lane(root, n, ahead, {"successor": [2] if n == 1 else [], neighbour: [10 + n]})
        _lane(root, 10 + n, against, {"successor": [11] if n == 2 else [], neighbour: [n]})
    return root


def bidirectional_map(length_m: float = 120) -> ElementTree.Element:
    """Drawn street of two lanelets that both directions use."""
    root = ElementTree.Element("commonRoad", benchmarkID="ZAM_Drawn-2_1_T-1", commonRoadVersion="2020a")
    for n, begin in enumerate((0.0, length_m / 2), 1):
        along = np.linspace(begin, begin + length_m / 2, 40)
        links = {"predecessor": [1] if n == 2 else [], "successor": [2] if n == 1 else []}
        _lane(root, n, (kerb(along, 1), kerb(along, -1)), links)
        ElementTree.SubElement(root[-1], "userBidirectional").text = "vehicle"
    return root


def add_obstacle(root: ElementTree.Element, place: Array, heading: float, shape: str, version: str = "2020a") -> None:
    """Static obstacle with a shape given as XML, placed in the plane."""
    tag = "staticObstacle" if version == "2020a" else "obstacle"
    obstacle = ElementTree.SubElement(root, tag, id=str(100 + len(root)))
    if version == "2018b":
        ElementTree.SubElement(obstacle, "role").text = "static"
    obstacle.append(ElementTree.fromstring(f"<shape>{shape}</shape>"))
    state = ElementTree.SubElement(obstacle, "initialState")
    _points(ElementTree.SubElement(state, "position"), place[None])
    ElementTree.SubElement(ElementTree.SubElement(state, "orientation"), "exact").text = repr(heading)


def written(root: ElementTree.Element, path: Path) -> Path:
    ElementTree.ElementTree(root).write(path)
    return path
