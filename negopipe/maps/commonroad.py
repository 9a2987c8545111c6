"""Reader of CommonRoad scenarios (XML 2018b and 2020a): opposing lanelets, static obstacles as parked vehicles."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from negopipe.errors import UserError
from negopipe.maps.assembly import assemble, with_parked
from negopipe.maps.chain import Piece, longest_street
from negopipe.maps.parking import KerbsideRow, Parking
from negopipe.maps.street import Array, MapStreet, to_line
from negopipe.maps.xml_file import number, read_root, whole_number

BESIDE_M = 8.0
"""Largest distance of a static obstacle's middle from the kerb at which it still counts as one of the street."""
CIRCLE = np.linspace(0, 2 * np.pi, 17)[:-1]
"""Directions of the points that stand for a circle."""


@dataclass(frozen=True)
class _Lanelet:
    """Lanelet with its bounds [N, 2] in its direction, its successors and predecessors, and its opposing neighbour.

    `opposing` is on the left where traffic keeps to the right (`is_left`), else on the right.
    """

    id: int
    left: Array
    right: Array
    successors: tuple[int, ...]
    predecessors: tuple[int, ...]
    opposing: int | None
    is_left: bool
    is_two_way: bool


def read_scenario_root(path: Path) -> ElementTree.Element:
    """Root element of a CommonRoad file."""
    return read_root(path, "commonRoad", "a CommonRoad scenario (XML)")


def read_commonroad(path: Path, ids: Sequence[int], parking: Parking, rows: Sequence[KerbsideRow]) -> MapStreet:
    """Street of a CommonRoad scenario.

    path        the scenario, XML 2018b or 2020a
    ids         lanelets of the street, in any order, one of each opposing pair is enough; none: the longest street.
                It runs from the first named one on, a single one along it
    parking     how the rows are filled
    rows        parked vehicles along its kerbs: published scenarios have none beside two-way streets

    A street consists of adjacent lanelets with opposite directions and of ones that both directions use, chained by
    their successors. Static obstacles beside or on it become parked vehicles; of a shape that is no rectangle the
    bounding box along the obstacle's orientation counts. `UserError`: no such scenario, no lanelets, no two-way
    street, ids not found, a street too short or with bends too tight.
    """
    root = read_scenario_root(path)
    lanelets = {lane.id: lane for lane in (_lanelet(path, element) for element in root.findall("lanelet"))}
    if not lanelets:
        raise UserError(f"{path}: has no lanelets; a CommonRoad scenario with roads is needed")
    name = root.get("benchmarkID") or path.stem
    street = assemble(path, name, longest_street(path, _pieces(lanelets), ids))
    boxes = [_box(path, element) for element in root if _is_static(element)]
    return with_parked(path, street, _beside(street, np.array(boxes).reshape(-1, 5)), rows, parking)


def points_of(path: Path, element: ElementTree.Element | None) -> Array:
    """Points [N, 2] in an element; a third coordinate is left out."""
    found = [] if element is None else element.findall("point")
    return np.array([[number(path, p.findtext(axis), f"{axis} of a point") for axis in "xy"] for p in found])


def exact_value(path: Path, element: ElementTree.Element | None, what: str) -> float:
    """Exact value in an element, or the middle of its interval."""
    start, end = (
        (None, None) if element is None else (element.findtext("intervalStart"), element.findtext("intervalEnd"))
    )
    if start is not None and end is not None:
        return (number(path, start, what) + number(path, end, what)) / 2
    return number(path, None if element is None else element.findtext("exact"), what)


def point_of_state(path: Path, state: ElementTree.Element | None, what: str) -> Array:
    """Position [2] of a state."""
    points = points_of(path, None if state is None else state.find("position"))
    if len(points) != 1:
        raise UserError(f"{path}: the position of {what} is not one point; exact positions are allowed")
    return np.asarray(points[0])


def _lanelet(path: Path, element: ElementTree.Element) -> _Lanelet:
    name = whole_number(path, element.get("id"), "the id of a lanelet")
    left, right = points_of(path, element.find("leftBound")), points_of(path, element.find("rightBound"))
    if min(len(left), len(right)) < 2:
        raise UserError(f"{path}: lanelet {name} has a bound of less than two points; two and more are needed")
    beside = {side: element.find(f"adjacent{side}") for side in ("Left", "Right")}
    opposing = {s: e for s, e in beside.items() if e is not None and e.get("drivingDir") == "opposite"}
    side, neighbour = next(iter(opposing.items()), ("Left", None))
    successors, predecessors = (
        tuple(whole_number(path, e.get("ref"), f"a {tag} of lanelet {name}") for e in element.findall(tag))
        for tag in ("successor", "predecessor")
    )
    return _Lanelet(
        id=name,
        left=left,
        right=right,
        successors=successors,
        predecessors=predecessors,
        opposing=None
        if neighbour is None
        else whole_number(path, neighbour.get("ref"), f"a neighbour of lanelet {name}"),
        is_left=side == "Left",
        is_two_way=element.find("userBidirectional") is not None,
    )


def _pieces(lanelets: dict[int, _Lanelet]) -> dict[Hashable, Piece]:
    """Stretches that both directions use, in both directions, with their successors.

    A key is the lanelet and 1, or -1 for a lanelet of both directions seen backwards.
    """
    pieces: dict[Hashable, Piece] = {}
    for lane in lanelets.values():
        ahead = tuple((i, 1) for i in lane.successors)
        if lane.is_two_way:
            behind = tuple((i, -1) for i in lane.predecessors)
            forth, back = (lane.id, 1), (lane.id, -1)
            pieces[forth] = Piece(forth, back, (lane.id,), lane.left, lane.right, ahead, False)
            pieces[back] = Piece(back, forth, (lane.id,), lane.right[::-1], lane.left[::-1], behind, True)
        elif lane.opposing in lanelets:
            other = lanelets[lane.opposing]
            left = other.right[::-1] if lane.is_left else lane.left
            right = lane.right if lane.is_left else other.left[::-1]
            pieces[lane.id, 1] = Piece((lane.id, 1), (other.id, 1), (lane.id, other.id), left, right, ahead, False)
    return pieces


def _is_static(element: ElementTree.Element) -> bool:
    """Whether an element is a static obstacle, by the names of 2020a or of 2018b."""
    return element.tag == "staticObstacle" or (element.tag == "obstacle" and element.findtext("role") == "static")


def _box(path: Path, element: ElementTree.Element) -> tuple[float, float, float, float, float]:
    """Box of an obstacle in the plane: x, y, heading, length, width."""
    what = f"obstacle {element.get('id')}"
    state = element.find("initialState")
    place = point_of_state(path, state, what)
    heading = exact_value(path, None if state is None else state.find("orientation"), f"the orientation of {what}")
    shape = element.find("shape")
    outlines = [_outline(path, part, what) for part in (() if shape is None else shape)]
    if len(outlines) == 1 and shape is not None and shape[0].tag == "rectangle":
        turn = float(shape[0].findtext("orientation") or 0)
    else:
        turn = 0.0
    if not outlines:
        raise UserError(f"{path}: {what} has no shape; rectangles, circles and polygons are allowed")
    back = _rotation(-turn)
    local = np.concatenate(outlines) @ back.T
    low, high = local.min(0), local.max(0)
    middle = place + _rotation(heading + turn) @ ((low + high) / 2)
    return float(middle[0]), float(middle[1]), heading + turn, float(high[0] - low[0]), float(high[1] - low[1])


def _rotation(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _outline(path: Path, shape: ElementTree.Element, what: str) -> Array:
    """Points [N, 2] of a shape's outline in the obstacle's frame."""
    if shape.tag == "polygon":
        points = points_of(path, shape)
        if len(points) < 3:
            raise UserError(f"{path}: {what} has a polygon of {len(points)} points; three and more are allowed")
        return points
    centre = shape.find("center")
    middle = np.zeros(2)
    if centre is not None:
        middle = np.array([number(path, centre.findtext(axis), f"the center of {what}") for axis in "xy"])
    if shape.tag == "circle":
        radius = number(path, shape.findtext("radius"), f"the radius of {what}")
        return middle + radius * np.stack([np.cos(CIRCLE), np.sin(CIRCLE)], axis=-1)
    if shape.tag != "rectangle":
        raise UserError(f"{path}: {what} is a {shape.tag}; rectangles, circles and polygons are allowed")
    size = np.array([number(path, shape.findtext(key), f"the {key} of {what}") for key in ("length", "width")])
    turn = shape.findtext("orientation")
    angle = 0.0 if turn is None else number(path, turn, f"the orientation of {what}")
    return np.asarray(middle + (np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2 * size) @ _rotation(angle).T)


def _beside(street: MapStreet, boxes: Array) -> Array:
    """Parked vehicles [P, 5] of boxes [N, 5] in the plane that lie along the street, on it or beside it."""
    if not len(boxes):
        return boxes
    sigma, d = to_line(street, boxes[:, :2])
    along = np.clip(sigma, 0, street.length_m)
    kerb = np.where(
        d > 0, np.interp(along, street.sigma, street.left_m), np.interp(along, street.sigma, street.right_m)
    )
    near = (sigma == along) & (np.abs(d) < kerb + BESIDE_M)
    yaw = boxes[:, 2] - np.interp(along, street.sigma, street.heading)
    yaw = np.arctan2(np.sin(yaw), np.cos(yaw))
    return np.asarray(np.column_stack([sigma, d, yaw, boxes[:, 3:]])[near])
