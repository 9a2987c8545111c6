"""Small maps of streets: what a policy is trained and evaluated on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from negopipe.report.scene import PARKED, Scene, draw_scene, scene_of
from negopipe.report.style import ADAPTIVE_COLOR, CORRIDOR, INK, WIDTH_IN, styled
from negopipe.simulation.collisions import CollisionCheck
from negopipe.simulation.perception import other_columns
from negopipe.simulation.road import Road
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.waiting_place import ROOM_M, waiting_places

N_COLUMNS = 2
AROUND_M = 8.0
"""Length of a street that is shown beyond the places where vehicles start, m."""


@dataclass(frozen=True)
class StreetMap:
    """A street to be drawn.

    waiting_m: [W, 2] x, y of the last places at which the other can pass, world frame
    shown_m: length that is shown to both sides of the corridor's middle
    """

    title: str
    scene: Scene
    waiting_m: np.ndarray
    shown_m: float


def street_maps(scenario: ScenarioConfig, road: Road, n: int) -> dict[str, Figure]:
    """Figures by name: the first `n` streets of the training and of those that are held out, or the only one."""
    collisions = CollisionCheck(road, scenario.dt_s, other_columns(2, road.device))
    parts = {"streets_training": scenario.training_streets, "streets_held_out": scenario.held_out_streets}
    if scenario.training_streets == scenario.held_out_streets:
        parts = {"streets": scenario.held_out_streets}
    waiting_s = waiting_places(collisions, scenario.sizes, 0.0, ROOM_M).unflatten(0, (-1, 2)).cpu().numpy()
    return {
        name: gallery([_street_map(scenario, road, street, waiting_s[street - 1]) for street in part[:n]])
        for name, part in parts.items()
    }


@styled
def gallery(maps: Sequence[StreetMap]) -> Figure:
    """Maps of streets; the ego drives from the left to the right."""
    n_rows = -(-len(maps) // N_COLUMNS)
    figure = Figure((WIDTH_IN, 0.6 + 0.75 * n_rows), layout="constrained")
    axes = figure.subplots(n_rows, N_COLUMNS, squeeze=False).flatten()
    for axis in axes:
        axis.set_axis_off()
    for axis, street in zip(axes, maps, strict=False):
        _draw(axis, street)
    figure.legend(handles=_legend(), loc="outside upper center", ncols=3, fontsize=7, handlelength=1.2)
    return figure


def _draw(axis: Axes, street: StreetMap) -> None:
    draw_scene(axis, street.scene)
    for d, color in zip(street.scene.route_d_m, (ADAPTIVE_COLOR, INK), strict=True):
        axis.plot(*_beside(street.scene, street.scene.line_m[:, 0], d).T, color=color, linewidth=0.8)
    axis.plot(*street.waiting_m.T, "o", color=ADAPTIVE_COLOR, mec="white", markersize=4, mew=0.6)
    kerbs = street.scene.kerbs_m[:, np.abs(street.scene.line_m[:, 0]) < street.shown_m].reshape(-1, 2)
    (left, low), (right, high) = kerbs.min(0), kerbs.max(0)
    axis.set(xlim=(left, right), ylim=(low - 2, high + 2), aspect="equal")
    axis.set_title(street.title, fontsize=7, fontweight="normal")


def _street_map(scenario: ScenarioConfig, road: Road, street: int, waiting_s: np.ndarray) -> StreetMap:
    """street: its number; waiting_s: [2, M] m, of both ways, the last places at which the other can pass."""
    scene = scene_of(road, street, 0.0)
    half_m, points = float(road.corridor_m(road.ways[2 * street - 2])) / 2, []
    for s, d, sign in zip(waiting_s, scene.route_d_m, (1, -1), strict=True):
        sigma = sign * (np.unique(s[np.isfinite(s)]) - half_m)
        points.append(_beside(scene, sigma, np.interp(sigma, scene.line_m[:, 0], d)))
    starts_m = [family.start_distance_m[1] for family in scenario.families.values()]
    shown_m = half_m + max(scenario.ego_start_distance_m[1] + scenario.queue_m[0], *starts_m) + AROUND_M
    return StreetMap(f"street {street}: corridor {2 * half_m:.1f} m", scene, np.concatenate(points), shown_m)


def _beside(scene: Scene, sigma: np.ndarray, d: np.ndarray) -> np.ndarray:
    """[K, 2] x, y of points at an offset d to the left of the line."""
    x, y, heading = (np.interp(sigma, scene.line_m[:, 0], values) for values in scene.line_m[:, 1:].T)
    return np.stack([x - d * np.sin(heading), y + d * np.cos(heading)], -1)


def _legend() -> list[Patch | Line2D]:
    return [
        Line2D([], [], color=ADAPTIVE_COLOR, linewidth=0.8, label="route of the ego"),
        Line2D([], [], color=INK, linewidth=0.8, label="oncoming route"),
        Line2D([], [], color=ADAPTIVE_COLOR, marker="o", linestyle="", markersize=4, label="last waiting place"),
        Patch(color=CORRIDOR, label="narrow place"),
        Patch(color=PARKED, label="parked car"),
    ]
