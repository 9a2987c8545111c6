"""Drives written as a CommonRoad scenario (XML 2020a), and their trajectories read again."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

import numpy as np

from negopipe.errors import UserError, abbreviate
from negopipe.maps.commonroad import exact_value, point_of_state, read_scenario_root
from negopipe.maps.lanelets import largest_id
from negopipe.maps.street import Array, MapStreet, normals, to_plane
from negopipe.maps.xml_file import number, whole_number

BENCHMARK_ID = re.compile(r"[A-Z]{3}_[A-Za-z0-9]+-\d+_\d+_T-\d+")
"""Names that CommonRoad gives to scenarios with trajectories."""
KINDS = ("car", "truck", "bus", "bicycle", "motorcycle", "pedestrian", "unknown")
"""Types of dynamic obstacles that are written."""
DECIMALS = 6
"""Digits after the point of written numbers, m, rad, m/s and s."""
FIRST_VEHICLE = 1000
"""Smallest id of an obstacle, or else the first above those of the lanelets; the street's own two are 1 and 2."""


@dataclass(frozen=True)
class Trajectory:
    """Motion of one vehicle at T consecutive times, T >= 2.

    kind        one of `KINDS`
    length_m, width_m    of its box
    first_step  index of the first time: time = index * dt
    position    [T, 2]: middle of the box, in the street's plane
    heading     [T]: rad
    speed       [T]: m/s, negative when it reverses
    """

    kind: str
    length_m: float
    width_m: float
    first_step: int
    position: Array
    heading: Array
    speed: Array


def write_commonroad(
    to: Path | BinaryIO,
    street: MapStreet,
    trajectories: Sequence[Trajectory],
    dt_s: float,
    benchmark_id: str,
    author: str,
    lanelets: Sequence[ElementTree.Element] = (),
) -> None:
    """Write a drive as a CommonRoad scenario: lanelets, parked vehicles, one dynamic obstacle per trajectory.

    to              the file, which is written anew
    dt_s            time from one step to the next
    benchmark_id    e.g. ZAM_Karlsruhe-1_1_T-1: country (ZAM for none), map, its number, configuration, T, number

    lanelets        those of the map that the street is of (`read_lanelets`); none: the street's own two

    The street's line is the bound between its two lanelets; its kerbs are the outer ones. The first trajectory is the
    ego's: a planning problem leads from its first to its last place. CommonRoad's schema wants trajectories that begin
    at step 0; its reader takes any.
    """
    if not BENCHMARK_ID.fullmatch(benchmark_id):
        raise UserError(f"benchmark_id is {abbreviate(benchmark_id)!r}; a name like ZAM_Street-1_1_T-1 is allowed")
    root = ElementTree.Element(
        "commonRoad",
        timeStepSize=_text(dt_s),
        commonRoadVersion="2020a",
        author=author,
        affiliation="",
        source=street.source,
        benchmarkID=benchmark_id,
        date="1970-01-01",
    )
    location = ElementTree.SubElement(root, "location")
    for key, unknown in (("geoNameId", "-999"), ("gpsLatitude", "999"), ("gpsLongitude", "999")):
        ElementTree.SubElement(location, key).text = unknown
    ElementTree.SubElement(ElementTree.SubElement(root, "scenarioTags"), "two_lane")
    if lanelets:
        root.extend(lanelets)
    else:
        _add_lanelets(root, street)
    first = max(FIRST_VEHICLE, largest_id(lanelets) + 1)
    _add_parked(root, street, first)
    for index, trajectory in enumerate(trajectories):
        _add_trajectory(root, first + len(street.parked) + index, trajectory)
    if trajectories:
        _add_planning_problem(root, first + len(street.parked) + len(trajectories), trajectories[0])
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(to, encoding="UTF-8", xml_declaration=True)


def read_trajectories(path: Path) -> tuple[float, list[Trajectory]]:
    """Time step, s, and the trajectories of the dynamic obstacles of a CommonRoad scenario, in the file's order."""
    root = read_scenario_root(path)
    dt_s = number(path, root.get("timeStepSize"), "timeStepSize")
    return dt_s, [_trajectory(path, element) for element in root.findall("dynamicObstacle")]


def _text(value: float) -> str:
    return f"{float(value):.{DECIMALS}f}"


def _add_exact(parent: ElementTree.Element, tag: str, text: str) -> None:
    ElementTree.SubElement(ElementTree.SubElement(parent, tag), "exact").text = text


def _add_point(parent: ElementTree.Element, place: Array) -> None:
    point = ElementTree.SubElement(parent, "point")
    for axis, value in zip("xy", place, strict=True):
        ElementTree.SubElement(point, axis).text = _text(value)


def _add_lanelets(root: ElementTree.Element, street: MapStreet) -> None:
    """Lanelet 1 along the street to the right of its line, lanelet 2 against it to the left."""
    side = normals(street.heading)
    left, right = street.points + street.left_m[:, None] * side, street.points - street.right_m[:, None] * side
    bounds = {1: (street.points, right), 2: (street.points[::-1], left[::-1])}
    for name, (inner, outer) in bounds.items():
        lanelet = ElementTree.SubElement(root, "lanelet", id=str(name))
        for tag, line in (("leftBound", inner), ("rightBound", outer)):
            bound = ElementTree.SubElement(lanelet, tag)
            for place in line:
                _add_point(bound, place)
        ElementTree.SubElement(lanelet, "adjacentLeft", ref=str(3 - name), drivingDir="opposite")
        ElementTree.SubElement(lanelet, "laneletType").text = "urban"


def _add_obstacle(
    root: ElementTree.Element, tag: str, name: int, kind: str, size: tuple[float, float]
) -> ElementTree.Element:
    """Obstacle with its type and shape, still without a state."""
    obstacle = ElementTree.SubElement(root, tag, id=str(name))
    ElementTree.SubElement(obstacle, "type").text = kind
    rectangle = ElementTree.SubElement(ElementTree.SubElement(obstacle, "shape"), "rectangle")
    for key, value in zip(("length", "width"), size, strict=True):
        ElementTree.SubElement(rectangle, key).text = _text(value)
    return obstacle


def _add_state(parent: ElementTree.Element, tag: str, place: Array, heading: float, step: int, speed: float) -> None:
    state = ElementTree.SubElement(parent, tag)
    _add_point(ElementTree.SubElement(state, "position"), place)
    _add_exact(state, "orientation", _text(heading))
    _add_exact(state, "time", str(step))
    _add_exact(state, "velocity", _text(speed))


def _add_parked(root: ElementTree.Element, street: MapStreet, first: int) -> None:
    """first: id of the first parked vehicle."""
    sigma, d, yaw, length, width = street.parked.T
    places, headings = to_plane(street, sigma, d)
    for index in range(len(street.parked)):
        size = (float(length[index]), float(width[index]))
        obstacle = _add_obstacle(root, "staticObstacle", first + index, "parkedVehicle", size)
        _add_state(obstacle, "initialState", places[index], _wrapped(headings[index] + yaw[index]), 0, 0.0)


def _add_trajectory(root: ElementTree.Element, name: int, drive: Trajectory) -> None:
    times = len(drive.position)
    if times < 2 or not len(drive.heading) == len(drive.speed) == times:
        raise ValueError("a trajectory needs positions, headings and speeds at two and more equal times")
    if drive.kind not in KINDS:
        raise UserError(f"kind of a vehicle is {abbreviate(drive.kind)!r}; {', '.join(KINDS)} are allowed")
    if not all(np.isfinite(values).all() for values in (drive.position, drive.heading, drive.speed)):
        raise ValueError("a trajectory has numbers that are not finite")
    obstacle = _add_obstacle(root, "dynamicObstacle", name, drive.kind, (drive.length_m, drive.width_m))
    trajectory = ElementTree.Element("trajectory")
    for index in range(times):
        parent, tag = (trajectory, "state") if index else (obstacle, "initialState")
        step, heading = drive.first_step + index, _wrapped(drive.heading[index])
        _add_state(parent, tag, drive.position[index], heading, step, float(drive.speed[index]))
    obstacle.append(trajectory)


def _add_planning_problem(root: ElementTree.Element, name: int, drive: Trajectory) -> None:
    """Problem of the drive's vehicle: from its first state into a box around its last place by its last time."""
    problem = ElementTree.SubElement(root, "planningProblem", id=str(name))
    heading = _wrapped(drive.heading[0])
    _add_state(problem, "initialState", drive.position[0], heading, 0, float(drive.speed[0]))
    for unknown in ("yawRate", "slipAngle"):
        _add_exact(problem[0], unknown, _text(0.0))
    goal = ElementTree.SubElement(problem, "goalState")
    position = ElementTree.SubElement(goal, "position")
    rectangle = ElementTree.SubElement(position, "rectangle")
    for key, value in (
        ("length", drive.length_m),
        ("width", drive.width_m),
        ("orientation", _wrapped(drive.heading[-1])),
    ):
        ElementTree.SubElement(rectangle, key).text = _text(value)
    centre = ElementTree.SubElement(rectangle, "center")
    for axis, value in zip("xy", drive.position[-1], strict=True):
        ElementTree.SubElement(centre, axis).text = _text(value)
    time = ElementTree.SubElement(goal, "time")
    ElementTree.SubElement(time, "intervalStart").text = "1"
    ElementTree.SubElement(time, "intervalEnd").text = str(drive.first_step + len(drive.position) - 1)


def _wrapped(angle: float) -> float:
    """Angle within half a turn of 0, as CommonRoad demands."""
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


def _trajectory(path: Path, element: ElementTree.Element) -> Trajectory:
    what = f"vehicle {element.get('id')}"
    length, width = (
        number(path, element.findtext(f"shape/rectangle/{key}"), f"the {key} of {what}") for key in ("length", "width")
    )
    states = [s for s in (element.find("initialState"), *element.findall("trajectory/state")) if s is not None]
    if len(states) < 2:
        raise UserError(f"{path}: {what} has no trajectory; an initial state and one and more states are needed")
    steps = [whole_number(path, state.findtext("time/exact"), f"the time of {what}") for state in states]
    if steps != list(range(steps[0], steps[0] + len(steps))):
        raise UserError(f"{path}: the times of {what} are not consecutive; consecutive ones are allowed")
    return Trajectory(
        kind=element.findtext("type") or "unknown",
        length_m=length,
        width_m=width,
        first_step=steps[0],
        position=np.array([point_of_state(path, state, what) for state in states]),
        heading=np.unwrap([exact_value(path, s.find("orientation"), f"the orientation of {what}") for s in states]),
        speed=np.array([exact_value(path, s.find("velocity"), f"the velocity of {what}") for s in states]),
    )
