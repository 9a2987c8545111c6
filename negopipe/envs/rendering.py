"""Pictures of worlds for `render`, drawn as the report's films are; in a window for `render_mode="human"`."""

import math
import time
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from negopipe.envs.episode_record import Shot
from negopipe.envs.overrides import in_one_line
from negopipe.envs.worlds import Worlds
from negopipe.errors import UserError
from negopipe.evaluation.trace import ADAPTIVE
from negopipe.report.scene import limits_within, scene_of
from negopipe.report.street_view import DPI, HEADER_PX, TOP_PX, WIDTH_PX, Sheet, StreetView
from negopipe.report.style import planner_colors, styled
from negopipe.simulation.road import Road

MODES = ["human", "rgb_array"]
HEIGHT_PX = 272
"""Height of every picture; like the width a multiple of 16, as video codecs ask for."""
REACH_STEP_M = 10.0
"""The drawn length of street on either side is rounded up to a multiple of this, m."""
MOST_SHEETS = 64
"""Streets that are kept drawn."""


class Camera:
    """Draws shots of the worlds on a road as arrays [HEIGHT_PX, WIDTH_PX, 3] uint8; a copy begins without drawings."""

    def __init__(self, plan_s: float) -> None:
        self.plan_s = plan_s
        self._sheets: dict[tuple, tuple[Sheet, StreetView]] = {}

    def picture(self, road: Road, shot: Shot) -> np.ndarray:
        """The picture of a shot; the same street is drawn once."""
        reach_m = REACH_STEP_M * math.ceil(shot.reach_m / REACH_STEP_M)
        key = (shot.street, reach_m, shot.size_m.tobytes())
        if key not in self._sheets:
            if len(self._sheets) >= MOST_SHEETS:
                self._sheets.clear()
            self._sheets[key] = _sheet(road, shot, reach_m, self.plan_s)
        sheet, view = self._sheets[key]
        return sheet.draw(shot.moment.time_s, view.artists(shot.moment))

    def __getstate__(self) -> dict[str, Any]:
        return {"plan_s": self.plan_s, "_sheets": {}}  # drawings cannot be copied


@styled
def _sheet(road: Road, shot: Shot, reach_m: float, plan_s: float) -> tuple[Sheet, StreetView]:
    scene = scene_of(road, shot.street, plan_s)
    figure = Figure((WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI)
    road_px = HEIGHT_PX - TOP_PX - HEADER_PX
    axis = figure.add_axes((0, 0, 1, road_px / HEIGHT_PX))
    left, right, low, high = limits_within(reach_m, scene)
    width_m = max(right - left, (high - low) * WIDTH_PX / road_px)
    half_m, middle_x, middle_y = width_m / 2, (left + right) / 2, (low + high) / 2
    half_y_m = half_m * road_px / WIDTH_PX
    axis.set(xlim=(middle_x - half_m, middle_x + half_m), ylim=(middle_y - half_y_m, middle_y + half_y_m))
    view = StreetView(axis, scene, shot.size_m, planner_colors([ADAPTIVE], {})[ADAPTIVE], "agent")
    return Sheet(figure), view


class Window:
    """A window that shows pictures in real time; UserError where there is no display.

    fps: pictures per second
    """

    def __init__(self, fps: float) -> None:
        from matplotlib import pyplot  # chooses a backend when it is imported
        from matplotlib.backends.registry import BackendFilter, backend_registry

        backend = str(pyplot.get_backend())
        if backend.lower() in backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE):
            raise UserError(f"render_mode must be rgb_array or None without a display, got 'human' ({backend})")
        self._seconds, self._shown_at = 1 / fps, time.monotonic()
        self._pyplot = pyplot
        self._figure = pyplot.figure(figsize=(WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI)
        self._image = self._figure.add_axes((0, 0, 1, 1)).imshow(np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8))
        self._image.axes.axis("off")
        pyplot.show(block=False)

    def show(self, picture: np.ndarray) -> None:
        """Show a picture, at the earliest `1 / fps` after the one before."""
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        left_s = self._seconds - (time.monotonic() - self._shown_at)
        self._figure.canvas.start_event_loop(max(left_s, 0.001))
        self._shown_at = time.monotonic()

    def close(self) -> None:
        """Close the window."""
        self._pyplot.close(self._figure)


class View:
    """One world as its `render_mode` shows it: None, rgb_array or human; UserError for another mode.

    A copy has a window of its own.
    """

    def __init__(self, worlds: Worlds, render_mode: str | None) -> None:
        if render_mode is not None and render_mode not in MODES:
            raise UserError(f"render_mode must be one of {', '.join(MODES)} or None, got {in_one_line(render_mode)}")
        self.worlds, self.render_mode = worlds, render_mode
        self._camera = Camera(worlds.config.planner.horizon_s)
        self._open()

    def _open(self) -> None:
        self._window = Window(fps(self.worlds)) if self.render_mode == "human" else None

    def picture(self) -> np.ndarray | None:
        """The present state, or the last one of an episode that is over; None where no array is asked for."""
        return self._picture() if self.render_mode == "rgb_array" else None

    def show(self) -> None:
        """Show the present state in the window, if there is one."""
        if self._window is not None:
            self._window.show(self._picture())

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _picture(self) -> np.ndarray:
        end = self.worlds.ended.get(0)
        shot = self.worlds.record.shot(0) if end is None else end.shot
        return self._camera.picture(self.worlds.game.simulator.road, shot)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_window": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state
        self._open()


def fps(worlds: Worlds) -> int:
    """Pictures per second: one per control step in real time."""
    return max(1, round(1 / worlds.config.scenario.dt_s))
