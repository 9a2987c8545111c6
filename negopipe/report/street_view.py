"""One instant of a drive as films and windows show it: the street, the vehicles, and what the ego predicts of them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from negopipe.report.labels import horizon_label, outcome_label
from negopipe.report.scene import SOCIAL, Scene, add_polygon, box_corners, draw_scene, ribbon_corners
from negopipe.report.style import OUTCOME_COLORS, QUIET, horizon_color
from negopipe.safety.layer import INTERVENTIONS
from negopipe.simulation.state import EGO

WIDTH_PX, TOP_PX, HEADER_PX, DPI = 640, 26, 26, 100
RIBBON_ALPHA = 0.6


@dataclass(frozen=True)
class Moment:
    """State of V vehicles at one instant of an episode (column 0 is the ego).

    time_s: since the start
    position: [V, 2] m, yaw: [V] rad, speed: [V] m/s; world frame
    horizon_s: prediction horizon of the plan that the ego follows; NaN = it has none
    intervention: of the safety layer, index into `negopipe.safety.layer.INTERVENTIONS`; 0 = the ego drives by its plan
    outcome: name, where the episode is over; else None
    """

    time_s: float
    position: np.ndarray
    yaw: np.ndarray
    speed: np.ndarray
    horizon_s: float
    intervention: int
    outcome: str | None


class Sheet:
    """A figure of which the static parts are drawn once, and a clock and other moving parts on top.

    figure: with all its static parts; its moving parts are animated
    """

    def __init__(self, figure: Figure) -> None:
        height_px = figure.get_size_inches()[1] * DPI
        self.figure, self.canvas = figure, FigureCanvasAgg(figure)
        self.clock = figure.text(0.012, 1 - 5 / height_px, "", va="top", fontsize=12, animated=True)
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(figure.bbox)

    def draw(self, time_s: float, artists: list[Artist]) -> np.ndarray:
        """The picture at a time, [H, W, 3] uint8."""
        self.canvas.restore_region(self.background)  # type: ignore[no-untyped-call]
        self.clock.set_text(f"{time_s:.1f} s")
        for artist in (self.clock, *artists):
            self.figure.draw_artist(artist)
        return np.asarray(self.canvas.buffer_rgba())[:, :, :3].copy()


class StreetView:
    """The street with its vehicles in one panel of a figure.

    axis: its limits are set
    size_m: [V, 2] length and width of the vehicles
    color: of the ego
    label: beside the panel's title, in bold
    """

    def __init__(self, axis: Axes, scene: Scene, size_m: np.ndarray, color: str, label: str) -> None:
        self.axis, self.scene, self.size_m = axis, scene, size_m
        axis.axis("off")
        draw_scene(axis, scene)
        colors = [color, *[SOCIAL] * (len(size_m) - 1)]
        self.ribbons = [add_polygon(axis, QUIET, alpha=RIBBON_ALPHA) for _ in colors[1:]]
        self.bodies = [add_polygon(axis, color) for color in colors]
        self.windscreens = [add_polygon(axis, "white") for _ in colors]
        (self.crash,) = axis.plot([0], [0], "X", color=OUTCOME_COLORS["collision"], markersize=15, mec="white")
        above_road: Any = {"transform": axis.transAxes, "va": "bottom", "clip_on": False}
        self.title = axis.text(0.012, 1.03, label, fontsize=12, fontweight="bold", **above_road)
        self.horizon = axis.text(0.19, 1.03, "", fontsize=12, **above_road)
        self.status = axis.text(0.988, 1.03, "", fontsize=12, ha="right", **above_road)
        for artist in self._moving():
            artist.set_animated(True)

    def _moving(self) -> list[Artist]:
        shapes = [*self.ribbons, *self.bodies, *self.windscreens]
        return [*shapes, self.crash, self.horizon, self.status]

    def artists(self, moment: Moment) -> list[Artist]:
        """Move all parts to their places and return them in drawing order."""
        for vehicle, (body, windscreen) in enumerate(zip(self.bodies, self.windscreens, strict=True)):
            place, (length, width) = (moment.position[vehicle], moment.yaw[vehicle]), self.size_m[vehicle]
            body.set_xy(box_corners(*place, (-length / 2, length / 2), width))
            windscreen.set_xy(box_corners(*place, (0.14 * length, 0.3 * length), 0.8 * width))
        self._show_prediction(moment)
        self._show_status(moment)
        return self._moving()

    def _show_prediction(self, moment: Moment) -> None:
        horizon_s = moment.horizon_s
        has_horizon = not np.isnan(horizon_s)
        told = f"horizon {horizon_label(horizon_s)}" if has_horizon else ""
        if moment.intervention:
            told = f"safety: {INTERVENTIONS[moment.intervention].replace('_', ' ')}"
        self.horizon.set_text(told)
        for ribbon, vehicle in zip(self.ribbons, range(1, len(moment.yaw)), strict=True):
            way_m = moment.speed[vehicle] * min(horizon_s, self.scene.plan_s) if has_horizon else 0.0
            place = (moment.position[vehicle], moment.yaw[vehicle])
            ribbon.set_xy(ribbon_corners(self.scene, *place, way_m, self.size_m[vehicle][1]))
            ribbon.set_facecolor(horizon_color(horizon_s) if has_horizon else QUIET)

    def _show_status(self, moment: Moment) -> None:
        position, speed, outcome = moment.position, moment.speed, moment.outcome
        drives = f"ego {speed[EGO]:.1f} m/s, social {speed[EGO + 1]:.1f} m/s"
        self.status.set_text(drives if outcome is None else f"{outcome_label(outcome)} after {moment.time_s:.1f} s")
        self.status.set_fontweight("normal" if outcome is None else "bold")
        self.crash.set_visible(outcome == "collision")
        nearest = position[EGO + 1 :][np.abs(position[EGO + 1 :] - position[EGO]).sum(1).argmin()]
        middle = (position[EGO] + nearest) / 2
        self.crash.set_data(middle[:1], middle[1:])
