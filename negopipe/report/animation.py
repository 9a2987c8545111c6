"""Bird's-eye animations of evaluated episodes, in real time, as GIF; single frames as PNG.

One panel per planner and, with a `PolicyTrace`, a row below with the policy's grids, if it sees any, and the
probabilities of its horizons. While the safety layer drives, its name for that stands in the place of the horizon. The
ribbon ahead of a social vehicle is the ego's prediction of it: its path within the
prediction horizon at its present speed, in the colour of that horizon; an infinite one predicts as far as a plan.
"""

from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure
from PIL import Image

from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.replay import PolicyTrace
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.report.labels import horizon_label, outcome_label, planner_label
from negopipe.report.scene import (
    GROUND,
    PARKED,
    ROAD,
    SOCIAL,
    Scene,
    add_polygon,
    box_corners,
    draw_scene,
    ribbon_corners,
    view_limits,
)
from negopipe.report.style import CORRIDOR, INK, OUTCOME_COLORS, QUIET, horizon_color, planner_colors, styled
from negopipe.safety.layer import INTERVENTIONS
from negopipe.simulation.state import EGO

WIDTH_PX, TOP_PX, HEADER_PX, DPI = 640, 26, 26, 100
POLICY_PX, GRID_PX = 128, 96
HOLD_S = 1.5
"""Duration of the last frame before the animation repeats, s."""
RIBBON_ALPHA = 0.6
BLOCK_PX = 4
"""Height of a colour's block in the picture that gives the palette; enough pixels for the colour to be kept."""
N_COLORS = 128
"""Colours of the GIF's one palette; smoothed edges add shades to the colours named here."""
SLIDE_COLORS = 32
"""Colours of the palette of a slide; charts have few."""


def choose_episodes(trace: Trace, n_episodes: int) -> list[int]:
    """Indices of the episodes to show: successes at evenly spaced ranks of the return; the median for one episode.

    Without a success, all episodes are ranked. Equal returns rank by index.
    """
    shown = np.flatnonzero(trace.outcome == OUTCOMES.index("success"))
    if len(shown) == 0:
        shown = np.arange(len(trace.outcome))
    ranked = shown[np.argsort(trace.reward.sum(0)[shown], kind="stable")]
    n_shown = min(n_episodes, len(ranked))
    ranks = len(ranked) * (np.arange(n_shown) + 1) / (n_shown + 1)
    return [int(ranked[int(rank)]) for rank in ranks]


def worst_episode(trace: Trace) -> int:
    """Index of the episode with the lowest return, the first of equals."""
    return int(trace.reward.sum(0).argmin())


@styled
def animate(
    traces: Sequence[Trace],
    episode: int,
    scene: Scene,
    fps: int,
    fixed_s: FixedHorizons,
    policy_trace: PolicyTrace | None = None,
) -> bytes:
    """The episode under every planner of `traces`, one panel each, as a looping GIF in real time.

    policy_trace: inputs and outputs of the first planner, if it is the policy
    fps: rounded so that a frame lasts whole hundredths of a second, the unit of GIF
    """
    frame_s = round(100 / fps) / 100
    duration_s = max(trace.n_steps[episode] * trace.dt_s for trace in traces)
    n_frames = int(np.ceil(duration_s / frame_s)) + 1
    film = _Film(traces, episode, scene, fixed_s, policy_trace)
    frames = [film.draw(frame * frame_s) for frame in range(n_frames)]
    palette = _palette([frames[0], frames[n_frames // 2], frames[-1]], _horizons(traces, episode))
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations_ms = [round(1000 * frame_s)] * (n_frames - 1) + [round(1000 * HOLD_S)]
    buffer = BytesIO()
    flat[0].save(buffer, "GIF", save_all=True, append_images=flat[1:], duration=durations_ms, loop=0)
    return buffer.getvalue()


@styled
def still(
    traces: Sequence[Trace],
    episode: int,
    scene: Scene,
    time_s: float,
    fixed_s: FixedHorizons,
    policy_trace: PolicyTrace | None = None,
) -> bytes:
    """One frame of the animation as PNG; after the end of an episode its last state stays."""
    buffer = BytesIO()
    _Film(traces, episode, scene, fixed_s, policy_trace).draw(time_s).save(buffer, "PNG")
    return buffer.getvalue()


def slides(pngs: Sequence[bytes], seconds: float) -> bytes:
    """Pictures one after the other as a GIF, each shown for `seconds`."""
    first, *rest = (Image.open(BytesIO(png)).convert("RGB").quantize(SLIDE_COLORS) for png in pngs)
    buffer = BytesIO()
    first.save(buffer, "gif", save_all=True, append_images=rest, duration=round(seconds * 1e3), loop=0)
    return buffer.getvalue()


def _horizons(traces: Sequence[Trace], episode: int) -> np.ndarray:
    """The prediction horizons that appear in the film, s."""
    used = np.concatenate([trace.horizon_s[: trace.n_steps[episode], episode, EGO] for trace in traces])
    return np.unique(used[~np.isnan(used)])


def _palette(frames: Sequence[Image.Image], horizons_s: np.ndarray) -> Image.Image:
    """One palette for all frames, so that static parts are the same in each and stored once.

    A ribbon's colour may be missing in the given frames, so a block of it over every background is added.
    """
    ribbons = np.array([to_rgb(horizon_color(horizon_s)) for horizon_s in horizons_s]).reshape(-1, 1, 3)
    grounds = np.array([to_rgb(color) for color in (ROAD, CORRIDOR, PARKED, GROUND)])
    mixed = RIBBON_ALPHA * ribbons + (1 - RIBBON_ALPHA) * grounds
    blocks = np.repeat(np.round(255 * mixed).astype(np.uint8).reshape(-1, 1, 3), WIDTH_PX, 1)
    blocks = np.repeat(blocks, BLOCK_PX, 0)
    return Image.fromarray(np.concatenate([*map(np.asarray, frames), blocks])).quantize(N_COLORS)


class _Film:
    """Draws frames: the static parts once, the moving parts on top."""

    def __init__(
        self,
        traces: Sequence[Trace],
        episode: int,
        scene: Scene,
        fixed_s: FixedHorizons,
        policy_trace: PolicyTrace | None = None,
    ) -> None:
        left_m, right_m, low_m, high_m = view_limits([trace.position_m[0, episode] for trace in traces], scene)
        road_px = round(WIDTH_PX * (high_m - low_m) / (right_m - left_m))
        below_px = 0 if policy_trace is None else POLICY_PX
        height_px = TOP_PX + len(traces) * (HEADER_PX + road_px + 4) + below_px
        self.figure = Figure((WIDTH_PX / DPI, height_px / DPI), dpi=DPI)
        self.canvas = FigureCanvasAgg(self.figure)
        self.panels: list[_Panel] = []
        self.policy_rows: list[_PolicyRow] = []
        for row, trace in enumerate(traces):
            bottom_px = height_px - TOP_PX - (row + 1) * (HEADER_PX + road_px) - row * 4
            axis = self.figure.add_axes((0, bottom_px / height_px, 1, road_px / height_px))
            axis.set(xlim=(left_m, right_m), ylim=(low_m, high_m))
            axis.axis("off")
            draw_scene(axis, scene)
            self.panels.append(_Panel(axis, trace, episode, scene, fixed_s))
        if policy_trace is not None:
            self.policy_rows.append(_PolicyRow(self.figure, policy_trace, traces[0].dt_s))
        self.clock = self.figure.text(0.012, 1 - 5 / height_px, "", va="top", fontsize=12, animated=True)
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

    def draw(self, time_s: float) -> Image.Image:
        self.canvas.restore_region(self.background)  # type: ignore[no-untyped-call]
        self.clock.set_text(f"{time_s:.1f} s")
        self.figure.draw_artist(self.clock)
        moving: list[_Panel | _PolicyRow] = [*self.panels, *self.policy_rows]
        for panel in moving:
            for artist in panel.artists_at(time_s):
                self.figure.draw_artist(artist)
        return Image.fromarray(np.asarray(self.canvas.buffer_rgba())[:, :, :3].copy())


class _Panel:
    """The moving parts of one planner's episode."""

    def __init__(self, axis: Axes, trace: Trace, episode: int, scene: Scene, fixed_s: FixedHorizons) -> None:
        self.axis, self.trace, self.episode, self.scene = axis, trace, episode, scene
        self.size_m = np.stack([trace.length_m[episode], trace.width_m[episode]], -1)
        self.yaw_rad = np.unwrap(trace.yaw_rad[:, episode], axis=0)
        n_vehicles = self.yaw_rad.shape[1]
        colors = [*planner_colors([trace.planner], fixed_s).values(), *[SOCIAL] * (n_vehicles - 1)]
        self.ribbons = [add_polygon(axis, QUIET, alpha=RIBBON_ALPHA) for _ in colors[1:]]
        self.bodies = [add_polygon(axis, color) for color in colors]
        self.windscreens = [add_polygon(axis, "white") for _ in colors]
        (self.crash,) = axis.plot([0], [0], "X", color=OUTCOME_COLORS["collision"], markersize=15, mec="white")
        above_road: Any = {"transform": axis.transAxes, "va": "bottom", "clip_on": False}
        label = planner_label(trace.planner, fixed_s)
        self.title = axis.text(0.012, 1.03, label, fontsize=12, fontweight="bold", **above_road)
        self.horizon = axis.text(0.19, 1.03, "", fontsize=12, **above_road)
        self.status = axis.text(0.988, 1.03, "", fontsize=12, ha="right", **above_road)
        for artist in self._moving():
            artist.set_animated(True)

    def _moving(self) -> list[Artist]:
        shapes = [*self.ribbons, *self.bodies, *self.windscreens]
        return [*shapes, self.crash, self.horizon, self.status]

    def artists_at(self, time_s: float) -> list[Artist]:
        """Move all parts to their places at a time and return them in drawing order."""
        end = self.trace.n_steps[self.episode]
        step = min(time_s / self.trace.dt_s, float(end))
        position, yaw, speed = self._motion(step)
        horizon_s = self.trace.horizon_s[min(int(step), end - 1), self.episode, EGO]
        for vehicle, (body, windscreen) in enumerate(zip(self.bodies, self.windscreens, strict=True)):
            length, width = self.size_m[vehicle]
            body.set_xy(box_corners(position[vehicle], yaw[vehicle], (-length / 2, length / 2), width))
            glass = (0.14 * length, 0.3 * length)
            windscreen.set_xy(box_corners(position[vehicle], yaw[vehicle], glass, 0.8 * width))
        self._show_prediction(position, yaw, speed, np.nan if step >= end else horizon_s)
        intervention = self.trace.intervention[min(int(step), end - 1), self.episode]
        if intervention > 0 and step < end:
            self.horizon.set_text(f"safety: {INTERVENTIONS[intervention].replace('_', ' ')}")
        self._show_status(step >= end, position, speed)
        return self._moving()

    def _motion(self, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position [V, 2], yaw [V], speed [V] between two decisions, interpolated linearly."""
        before = min(int(step), len(self.yaw_rad) - 2)
        share = step - before
        position = self.trace.position_m[before : before + 2, self.episode]
        speed = self.trace.speed_mps[before : before + 2, self.episode]
        yaw = self.yaw_rad[before : before + 2]
        return tuple((1 - share) * pair[0] + share * pair[1] for pair in (position, yaw, speed))  # type: ignore[return-value]

    def _show_prediction(self, position: np.ndarray, yaw: np.ndarray, speed: np.ndarray, horizon_s: float) -> None:
        has_horizon = not np.isnan(horizon_s)
        self.horizon.set_text(f"horizon {horizon_label(horizon_s)}" if has_horizon else "")
        for ribbon, vehicle in zip(self.ribbons, range(1, len(yaw)), strict=True):
            way_m = speed[vehicle] * min(horizon_s, self.scene.plan_s) if has_horizon else 0.0
            ribbon.set_xy(ribbon_corners(self.scene, position[vehicle], yaw[vehicle], way_m, self.size_m[vehicle][1]))
            ribbon.set_facecolor(horizon_color(horizon_s) if has_horizon else QUIET)

    def _show_status(self, is_over: bool, position: np.ndarray, speed: np.ndarray) -> None:
        outcome = OUTCOMES[self.trace.outcome[self.episode]]
        seconds = self.trace.n_steps[self.episode] * self.trace.dt_s
        ends = f"{outcome_label(outcome)} after {seconds:.1f} s"
        drives = f"ego {speed[EGO]:.1f} m/s, social {speed[EGO + 1]:.1f} m/s"
        self.status.set_text(ends if is_over else drives)
        self.status.set_fontweight("bold" if is_over else "normal")
        self.crash.set_visible(bool(is_over) and outcome == "collision")
        nearest = position[EGO + 1 :][np.abs(position[EGO + 1 :] - position[EGO]).sum(1).argmin()]
        middle = (position[EGO] + nearest) / 2
        self.crash.set_data(middle[:1], middle[1:])


class _PolicyRow:
    """Inputs and outputs of the policy: a row of grids, if it sees any, then a bar per horizon with its probability."""

    def __init__(self, figure: Figure, policy_trace: PolicyTrace, dt_s: float) -> None:
        self.policy_trace, self.dt_s = policy_trace, dt_s
        width_px, height_px = figure.get_size_inches() * DPI
        first = () if policy_trace.grids is None else tuple(policy_trace.grids[0])
        size_px = min(GRID_PX, round((0.6 * WIDTH_PX) / max(len(first), 1)) - 8)
        ink = ListedColormap([ROAD, INK])
        self.images = []
        for frame, grid in enumerate(first):
            left_px = 8 + frame * (size_px + 8)
            axis = figure.add_axes((left_px / width_px, 8 / height_px, size_px / width_px, size_px / height_px))
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(True)
            age_s = frame * policy_trace.frame_interval_s
            axis.set_title("grid: now" if frame == 0 else f"{age_s:g} s ago", fontsize=9, fontweight="normal", pad=3)
            self.images.append(axis.imshow(_as_driven(grid), ink, vmin=0, vmax=1, aspect="auto"))
        left_px = 8 + len(first) * (size_px + 8) + 50
        bars_px = (left_px, 8, width_px - left_px - 52, size_px)
        axis = figure.add_axes(
            (bars_px[0] / width_px, bars_px[1] / height_px, bars_px[2] / width_px, size_px / height_px)
        )
        axis.set_title("probability of each horizon", fontsize=9, fontweight="normal", pad=3)
        axis.set(xlim=(0, 1), xticks=[])
        axis.set_yticks(
            range(len(policy_trace.horizons_s)), [horizon_label(horizon_s) for horizon_s in policy_trace.horizons_s]
        )
        axis.tick_params(axis="y", length=0)
        axis.spines["bottom"].set_visible(False)
        axis.invert_yaxis()
        colors = [horizon_color(horizon) for horizon in policy_trace.horizons_s]
        self.bars = list(axis.barh(range(len(colors)), [0.0] * len(colors), height=0.7, color=colors))
        at_end: Any = {"transform": axis.get_yaxis_transform(), "va": "center", "fontsize": 9, "clip_on": False}
        self.shares = [axis.text(1.03, row, "", **at_end) for row in range(len(colors))]
        for artist in self._moving():
            artist.set_animated(True)

    def _moving(self) -> list[Artist]:
        return [*self.images, *self.bars, *self.shares]

    def artists_at(self, time_s: float) -> list[Artist]:
        """Parts of the decision that is being carried out; after the end, of the last one."""
        step = min(int(time_s / self.dt_s + 1e-6), len(self.policy_trace.probability) - 1)
        grids = () if self.policy_trace.grids is None else self.policy_trace.grids[step]
        for image, grid in zip(self.images, grids, strict=True):
            image.set_data(_as_driven(grid))
        for bar, text, share in zip(self.bars, self.shares, self.policy_trace.probability[step], strict=True):
            bar.set_width(float(share))
            text.set_text(f"{100 * share:.0f} %")
        return self._moving()


def _as_driven(grid: np.ndarray) -> np.ndarray:
    """A grid [H, W], row 0 farthest ahead and column 0 farthest to the left, turned so that ahead is to the right."""
    return grid[::-1].T
