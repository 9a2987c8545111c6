"""The street and its vehicles as animations draw them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Polygon, Rectangle

from negopipe.report.style import CORRIDOR, INK, QUIET
from negopipe.simulation.road import Road

GROUND, ROAD, PARKED, SOCIAL = "#DDE3DC", "#F7F7F5", "#B9BDC2", "#4A4A4A"


@dataclass(frozen=True)
class Scene:
    """Static parts of an animation, in the world frame, m and rad.

    parked_cars: [P, 5] x, y, yaw, length, width
    line_m: [K, 4] sigma (increasing), x, y and heading of the road's reference line
    kerbs_m: [2, K, 2] x, y of the right and the left kerb at these sigma
    corridors_m: of each narrow place [2, M, 2], the same from mouth to mouth
    route_d_m: [2, K] offset to the line's left of the routes along the line and against it
    plan_s: length of a plan, s
    """

    parked_cars: np.ndarray
    line_m: np.ndarray
    kerbs_m: np.ndarray
    corridors_m: Sequence[np.ndarray]
    route_d_m: np.ndarray
    plan_s: float


SceneOf = Callable[[int], Scene]
"""The scene of a street, by its number."""


SEEN_M = 60.0
"""Length of a drawn street on either side of its corridor, m."""


def scene_of(road: Road, street: int, plan_s: float) -> Scene:
    """A street as plain arrays for drawing; street: its number; plan_s: length of a plan, s."""
    along = torch.tensor(float(street), device=road.device)
    half_m = float(road.corridor_m(along)) / 2
    sigma = road.sampled(-half_m - SEEN_M, half_m + SEEN_M)
    direction = along * torch.tensor([[1.0], [-1.0]], device=road.device)
    sign = road.sign(direction)
    parked = road.parked_boxes(along)
    sizes = (2 * torch.as_tensor(half) for half in (parked.half_length, parked.half_width))
    places = road.narrow_places[int(road.way(along))] - half_m
    return Scene(
        parked_cars=torch.stack([parked.x, parked.y, torch.atan2(parked.sin, parked.cos), *sizes], -1).cpu().numpy(),
        line_m=torch.stack([sigma, *road.line(along).pose(sigma)], -1).cpu().numpy(),
        kerbs_m=road.kerb_lines(sigma, along).cpu().numpy(),
        corridors_m=[road.kerb_lines(road.sampled(*place), along).cpu().numpy() for place in places.tolist()],
        route_d_m=(sign * road.route_offset(sign * sigma + half_m, direction)[0]).cpu().numpy(),
        plan_s=plan_s,
    )


def add_polygon(axis: Axes, color: str, alpha: float = 1.0) -> Polygon:
    polygon = Polygon([(0.0, 0.0)] * 3, facecolor=color, linewidth=0, alpha=alpha)
    axis.add_patch(polygon)
    return polygon


def view_limits(starts: Sequence[np.ndarray], scene: Scene) -> tuple[float, float, float, float]:
    """Left, right, lower and upper limit of a panel, m: the road between the outermost of `starts` (each [V, 2])."""
    return limits_within(
        max(abs(along_street(scene, position)[0]) for start in starts for position in start) + 4, scene
    )


def limits_within(reach_m: float, scene: Scene) -> tuple[float, float, float, float]:
    """Left, right, lower and upper limit of a panel, m: the road within `reach_m` of the corridor's middle."""
    sigma = scene.line_m[:, 0]
    shown = np.linspace(-reach_m, reach_m, 201)
    x, y = (np.concatenate([np.interp(shown, sigma, kerb[:, axis]) for kerb in scene.kerbs_m]) for axis in (0, 1))
    return x.min(), x.max(), y.min() - 0.7, y.max() + 0.7


def draw_scene(axis: Axes, scene: Scene) -> None:
    axis.add_patch(Rectangle((0, 0), 1, 1, transform=axis.transAxes, color=GROUND, lw=0))
    for (right, left), color in [(scene.kerbs_m, ROAD), *((each, CORRIDOR) for each in scene.corridors_m)]:
        axis.add_patch(Polygon(np.concatenate([right, left[::-1]]), color=color, lw=0))
    for kerb in scene.kerbs_m:
        axis.plot(*kerb.T, color=INK, linewidth=1.0)
    for x, y, yaw, length, width in scene.parked_cars:
        corners = box_corners(np.array([x, y]), yaw, (-length / 2, length / 2), width)
        axis.add_patch(Polygon(corners, facecolor=PARKED, edgecolor=QUIET, lw=0.8))


def box_corners(center: np.ndarray, yaw_rad: float, along_m: tuple[float, float], width_m: float) -> np.ndarray:
    """[4, 2] corners of a rectangle in the body frame's `along_m` interval, in the world frame."""
    body = np.array([(x, y) for x, y in zip(np.repeat(along_m, 2), (-1, 1, 1, -1), strict=True)])
    body[:, 1] *= width_m / 2
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return center + body @ np.array([[cos, sin], [-sin, cos]])


def along_street(scene: Scene, position: np.ndarray) -> tuple[float, float]:
    """sigma (m) of a position [2] on the road, and the line's heading there (rad)."""
    sigma, x, y, heading = scene.line_m[np.hypot(*(scene.line_m[:, 1:3] - position).T).argmin()]
    ahead = (position[0] - x) * np.cos(heading) + (position[1] - y) * np.sin(heading)
    return float(sigma + ahead), float(heading)


def ribbon_corners(scene: Scene, position: np.ndarray, yaw_rad: float, way_m: float, width_m: float) -> np.ndarray:
    """[2N, 2] outline of the next `way_m` metres of the route of a vehicle of `width_m` at `position`."""
    start, line_heading = along_street(scene, position)
    is_against = bool(np.cos(yaw_rad - line_heading) < 0)
    sigma = start + (-1 if is_against else 1) * np.linspace(0, way_m, 24)
    d, x, y, heading = (
        np.interp(sigma, scene.line_m[:, 0], values)
        for values in (scene.route_d_m[int(is_against)], *scene.line_m[:, 1:].T)
    )
    half = 0.8 * width_m / 2
    right, left = (np.stack([x - e * np.sin(heading), y + e * np.cos(heading)], -1) for e in (d - half, d + half))
    return np.concatenate([right, left[::-1]])
