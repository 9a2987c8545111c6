"""Reader of lanelet2 maps: OSM XML with lanelets, parking areas and nodes in metres or in degrees."""

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from negopipe.errors import UserError
from negopipe.maps.assembly import assemble, with_parked
from negopipe.maps.chain import Piece, longest_street
from negopipe.maps.parking import KerbsideRow, Parking, park_in_areas
from negopipe.maps.projection import project
from negopipe.maps.street import Array, MapStreet
from negopipe.maps.xml_file import number, read_root, whole_number

ROADS = ("road", "play_street")
"""Subtypes of lanelets that cars drive on in towns."""
TWO_WAY = ("no", "false")
ORIGIN_DEG = 0.01
"""Grid to which the map's middle is rounded for the projection's origin: parts of a map keep its coordinates."""


_Key = tuple[int, int, int]
"""Lanelet, its opposing one or itself, and 0 for a pair, 1 or -1 for a lanelet of both directions ahead or back."""


@dataclass(frozen=True)
class _Border:
    """Border of a lanelet in one direction: its way, whether that is turned around, its nodes."""

    way: int
    nodes: tuple[int, ...]

    def turned(self) -> "_Border":
        return _Border(self.way, self.nodes[::-1])


@dataclass(frozen=True)
class _Lanelet:
    """Lanelet with its borders in its own direction."""

    id: int
    left: _Border
    right: _Border
    is_two_way: bool


class _Map:
    """Nodes [x, y], ways (node ids), relations (tags and members) of an OSM file."""

    def __init__(self, path: Path) -> None:
        root = read_root(path, "osm", "a lanelet2 map (OSM XML)")
        self.path = path
        self.places = _places(path, root.findall("node"))
        self.ways = {
            self._id(way): tuple(whole_number(path, nd.get("ref"), "a node of a way") for nd in way.findall("nd"))
            for way in root.findall("way")
        }
        self.way_tags = {self._id(way): _tags(way) for way in root.findall("way")}
        self.relations = {self._id(relation): relation for relation in root.findall("relation")}

    def _id(self, element: ElementTree.Element) -> int:
        return whole_number(self.path, element.get("id"), f"the id of a {element.tag}")

    def nodes(self, way: int) -> tuple[int, ...]:
        """Nodes of a way, at least two, all known."""
        nodes = self.ways.get(way, ())
        if len(nodes) < 2 or any(node not in self.places for node in nodes):
            raise UserError(
                f"{self.path}: way {way} is missing or lacks nodes; ways of two and more known nodes are needed"
            )
        return nodes

    def line(self, nodes: Sequence[int]) -> Array:
        return np.array([self.places[node] for node in nodes])

    def members(self, relation: ElementTree.Element, role: str) -> list[int]:
        """Ways of a relation in a role."""
        found = [m for m in relation.findall("member") if m.get("type") == "way" and m.get("role") == role]
        return [whole_number(self.path, m.get("ref"), "a member of a relation") for m in found]


def read_lanelet2(path: Path, ids: Sequence[int], parking: Parking, rows: Sequence[KerbsideRow]) -> MapStreet:
    """Street of a lanelet2 map (OSM XML).

    path        the map; its nodes have tags local_x and local_y, m, or else are projected from latitude and longitude
                (transverse Mercator, WGS84, the central meridian through the map, true scale there)
    ids         lanelets of the street, in any order; none: the longest street. It runs from the first named one on, a
                single one along it
    parking     how its parking areas are filled
    rows        further parked vehicles along its kerbs

    A street consists of lanelets with one_way=no and of opposing ones that share a border. Successors share the nodes
    at their ends. `UserError`: no such map, no lanelets, no two-way street, ids not found, a street too short or with
    bends too tight.
    """
    osm = _Map(path)
    lanelets = _lanelets(osm)
    if not lanelets:
        raise UserError(f"{path}: has no lanelets of subtype {' or '.join(ROADS)}; a lanelet2 map with roads is needed")
    street = assemble(path, path.stem, longest_street(path, _pieces(osm, lanelets), ids))
    parked = park_in_areas(street, _parking_areas(osm), parking)
    return with_parked(path, street, parked, rows, parking)


def _tags(element: ElementTree.Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.findall("tag")}


def _places(path: Path, nodes: list[ElementTree.Element]) -> dict[int, Array]:
    """Position in metres of every node."""
    names = [whole_number(path, node.get("id"), "the id of a node") for node in nodes]
    if not nodes:
        return {}
    tags = [_tags(node) for node in nodes]
    if all("local_x" in tag and "local_y" in tag for tag in tags):
        metres = np.array([[number(path, tag[key], key) for key in ("local_x", "local_y")] for tag in tags])
    else:
        degrees = np.array(
            [[number(path, node.get(key), f"{key} of a node") for key in ("lat", "lon")] for node in nodes]
        )
        if np.abs(degrees[:, 0]).max() >= 90:
            raise UserError(f"{path}: lat of a node is {np.abs(degrees[:, 0]).max():g}; -90 < lat < 90 is allowed")
        middle = np.round(np.median(degrees, axis=0) / ORIGIN_DEG) * ORIGIN_DEG
        metres = project(degrees[:, 0], degrees[:, 1], (float(middle[0]), float(middle[1])))
    return dict(zip(names, metres, strict=True))


def _lanelets(osm: _Map) -> list[_Lanelet]:
    """Lanelets for cars."""
    found = []
    for name, relation in osm.relations.items():
        tags = _tags(relation)
        left, right = osm.members(relation, "left"), osm.members(relation, "right")
        if tags.get("type") == "lanelet" and tags.get("subtype") in ROADS and len(left) == len(right) == 1:
            two_way = tags.get("one_way", "yes") in TWO_WAY
            borders = _aligned(osm, _Border(left[0], osm.nodes(left[0])), _Border(right[0], osm.nodes(right[0])))
            found.append(_Lanelet(name, *borders, two_way))
    return found


def _aligned(osm: _Map, left: _Border, right: _Border) -> tuple[_Border, _Border]:
    """Borders of a lanelet in its direction: the left one on the left, both with the same sense."""
    a, b = osm.line(left.nodes), osm.line(right.nodes)
    straight = np.linalg.norm(a[0] - b[0]) + np.linalg.norm(a[-1] - b[-1])
    crossed = np.linalg.norm(a[0] - b[-1]) + np.linalg.norm(a[-1] - b[0])
    if crossed < straight:
        right, b = right.turned(), b[::-1]
    ring = np.concatenate([b, a[::-1]])
    x, y = (ring - ring[0]).T
    if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0:  # the ring right, then left backwards turns to the left
        left, right = left.turned(), right.turned()
    return left, right


def _pieces(osm: _Map, lanelets: list[_Lanelet]) -> dict[Hashable, Piece]:
    """Stretches that both directions use, in both directions, with their successors."""
    kerbs: dict[_Key, tuple[tuple[int, ...], _Border, _Border]] = {}
    for lane in lanelets:
        if lane.is_two_way:
            kerbs[lane.id, lane.id, 1] = ((lane.id,), lane.left, lane.right)
            kerbs[lane.id, lane.id, -1] = ((lane.id,), lane.right.turned(), lane.left.turned())
    kerbs |= _opposing([lane for lane in lanelets if not lane.is_two_way])
    starting: defaultdict[tuple[int, int], list[_Key]] = defaultdict(list)
    for key, (_, left, right) in kerbs.items():
        starting[left.nodes[0], right.nodes[0]].append(key)
    return {
        key: Piece(
            key=key,
            twin=_twin(key),
            ids=ids,
            left=osm.line(left.nodes),
            right=osm.line(right.nodes),
            next=tuple(n for n in starting[left.nodes[-1], right.nodes[-1]] if n != _twin(key)),
            is_backward=key[-1] == -1,
        )
        for key, (ids, left, right) in kerbs.items()
    }


def _twin(key: _Key) -> _Key:
    return (key[1], key[0], 0) if key[2] == 0 else (key[0], key[1], -key[2])


def _opposing(lanelets: list[_Lanelet]) -> dict[_Key, tuple[tuple[int, ...], _Border, _Border]]:
    """Pairs of one-way lanelets with opposite directions that share a border, seen along each of the two."""
    by_left, by_right = ({border(lane): lane for lane in lanelets} for border in (_left, _right))
    found: dict[_Key, tuple[tuple[int, ...], _Border, _Border]] = {}
    for lane in lanelets:
        drives_right = by_left.get((lane.left.way, lane.left.nodes[::-1]))
        drives_left = by_right.get((lane.right.way, lane.right.nodes[::-1]))
        if drives_right is not None:
            kerbs = (drives_right.right.turned(), lane.right)
            found[lane.id, drives_right.id, 0] = ((lane.id, drives_right.id), *kerbs)
        elif drives_left is not None:
            kerbs = (lane.left, drives_left.left.turned())
            found[lane.id, drives_left.id, 0] = ((lane.id, drives_left.id), *kerbs)
    return found


def _left(lane: _Lanelet) -> tuple[int, tuple[int, ...]]:
    return lane.left.way, lane.left.nodes


def _right(lane: _Lanelet) -> tuple[int, tuple[int, ...]]:
    return lane.right.way, lane.right.nodes


def _parking_areas(osm: _Map) -> list[Array]:
    """Outlines [N, 2] of parking areas: relations (multipolygons) and closed ways."""
    areas = []
    for relation in osm.relations.values():
        tags = _tags(relation)
        if tags.get("type") == "multipolygon" and tags.get("subtype") == "parking":
            ring = _ring([osm.nodes(way) for way in osm.members(relation, "outer")])
            areas += [osm.line(ring)] if len(ring) >= 3 else []
    for way, tags in osm.way_tags.items():
        if tags.get("area") == "yes" and "parking" in (tags.get("type"), tags.get("subtype")):
            areas.append(osm.line(osm.nodes(way)))
    return areas


def _ring(ways: list[tuple[int, ...]]) -> list[int]:
    """Nodes of a closed ring of ways in any order and sense; ways that do not join the ring are left out."""
    if not ways:
        return []
    ring, rest = list(ways[0]), list(ways[1:])
    while ring[0] != ring[-1]:
        joined = next((way for way in rest if ring[-1] in (way[0], way[-1])), None)
        if joined is None:
            break
        rest.remove(joined)
        ring += joined[1:] if joined[0] == ring[-1] else joined[-2::-1]
    return ring[:-1] if ring[0] == ring[-1] else ring
