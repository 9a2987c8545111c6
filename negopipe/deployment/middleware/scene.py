"""A decision as drawings that Foxglove and RViz show: kerbs, parked vehicles, road users, the ego and its plan."""

from collections.abc import Iterable, Iterator, Sequence

from negopipe.deployment.messages import Array, ObjectState, Trajectory
from negopipe.deployment.middleware.codec import Message, make
from negopipe.deployment.middleware.incoming import kerbs, parked_boxes
from negopipe.deployment.middleware.interface import SCENE
from negopipe.deployment.middleware.outgoing import header, pose
from negopipe.deployment.settings import Footprint

CUBE, LINE_STRIP, TEXT, DELETE_ALL = 1, 4, 9, 3
"""`visualization_msgs/Marker.type`, and an action."""

HEIGHT_M, LINE_M = 1.5, 0.15
"""Height of vehicles and width of lines."""

GREY, DARK, ORANGE, BLUE, RED = (0.6, 0.6, 0.6), (0.3, 0.3, 0.3), (0.9, 0.5, 0.1), (0.1, 0.4, 0.9), (0.9, 0.1, 0.1)


def scene_message(
    plan: Trajectory,
    objects: Iterable[ObjectState],
    street: Message,
    parked: Message | None,
    ego: Footprint,
    stamp: int,
    z: float,
) -> Message:
    """objects: heard since the last decision; stamp: ns; z: height of the ground, m"""
    left, right = kerbs(street)
    color = RED if plan.diagnostics.stop else BLUE
    x, y, yaw = plan.states[0, :3].tolist()
    markers = [
        *(_line("kerbs", kerb, GREY, z) for kerb in (left, right)),
        *(_box("parked", box, DARK, z) for box in parked_boxes(parked).tolist()),
        *(_box("objects", (o.x, o.y, o.yaw, o.length, o.width), ORANGE, z) for o in _newest(objects)),
        _box("ego", (x, y, yaw, *ego), color, z),
        _line("plan", plan.states[:, :2], color, z),
        _text(plan, x, y, z),
    ]
    old = make("visualization_msgs/msg/Marker", action=DELETE_ALL)
    for index, marker in enumerate((old, *markers)):
        marker.header, marker.id = header(stamp), index
    return make(SCENE.type_name, markers=[old, *markers])


def _newest(objects: Iterable[ObjectState]) -> Iterator[ObjectState]:
    """The newest message of each road user."""
    return iter({each.id: each for each in sorted(objects, key=lambda each: each.time_s)}.values())


def _marker(name: str, kind: int, color: tuple[float, float, float], scale: tuple[float, float, float]) -> Message:
    red, green, blue = color
    x, y, z = scale
    return make(
        "visualization_msgs/msg/Marker",
        ns=name,
        type=kind,
        pose=pose(0.0, 0.0, 0.0, 0.0),
        scale=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        color=make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
    )


def _box(name: str, box: Sequence[float], color: tuple[float, float, float], z: float) -> Message:
    """box: x, y (m), yaw (rad), length, width (m)"""
    x, y, yaw, length, width = box
    marker = _marker(name, CUBE, color, (length, width, HEIGHT_M))
    marker.pose = pose(x, y, z + HEIGHT_M / 2, yaw)
    return marker


def _line(name: str, places: Array, color: tuple[float, float, float], z: float) -> Message:
    marker = _marker(name, LINE_STRIP, color, (LINE_M, 0.0, 0.0))
    marker.points = [make("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y in places.tolist()]
    return marker


def _text(plan: Trajectory, x: float, y: float, z: float) -> Message:
    said = plan.diagnostics
    marker = _marker("horizon", TEXT, DARK, (0.0, 0.0, 1.0))
    marker.pose = pose(x, y, z + 2 * HEIGHT_M, 0.0)
    marker.text = f"stop: {said.stop}" if said.stop else f"{plan.horizon_s:g} s"
    return marker
