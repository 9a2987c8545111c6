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
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure
from PIL import Image

from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.replay import PolicyTrace
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.report.labels import horizon_label, planner_label
from negopipe.report.scene import GROUND, PARKED, ROAD, Scene, view_limits
from negopipe.report.street_view import DPI, HEADER_PX, RIBBON_ALPHA, TOP_PX, WIDTH_PX, Moment, Sheet, StreetView
from negopipe.report.style import CORRIDOR, INK, horizon_color, planner_colors, styled
from negopipe.simulation.state import EGO

POLICY_PX, GRID_PX = 128, 96
HOLD_S = 1.5
"""Duration of the last frame before the animation repeats, s."""
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
    return _gif(flat, durations_ms)


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
    pictures = [Image.open(BytesIO(png)).convert("RGB").quantize(SLIDE_COLORS) for png in pngs]
    return _gif(pictures, [round(1000 * seconds)] * len(pictures))


def _gif(frames: Sequence[Image.Image], durations_ms: Sequence[int]) -> bytes:
    """Frames with palettes as a GIF that repeats, not interlaced, as `player.js` reads it."""
    buffer = BytesIO()
    options: Any = {"save_all": True, "append_images": frames[1:], "duration": list(durations_ms), "loop": 0}
    frames[0].save(buffer, "GIF", interlace=0, **options)
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
        figure = Figure((WIDTH_PX / DPI, height_px / DPI), dpi=DPI)
        self.panels: list[_Panel] = []
        self.policy_rows: list[_PolicyRow] = []
        for row, trace in enumerate(traces):
            bottom_px = height_px - TOP_PX - (row + 1) * (HEADER_PX + road_px) - row * 4
            axis = figure.add_axes((0, bottom_px / height_px, 1, road_px / height_px))
            axis.set(xlim=(left_m, right_m), ylim=(low_m, high_m))
            self.panels.append(_Panel(axis, trace, episode, scene, fixed_s))
        if policy_trace is not None:
            self.policy_rows.append(_PolicyRow(figure, policy_trace, traces[0].dt_s))
        self.sheet = Sheet(figure)

    def draw(self, time_s: float) -> Image.Image:
        moving: list[_Panel | _PolicyRow] = [*self.panels, *self.policy_rows]
        return Image.fromarray(
            self.sheet.draw(time_s, [artist for part in moving for artist in part.artists_at(time_s)])
        )


class _Panel:
    """The moving parts of one planner's episode."""

    def __init__(self, axis: Axes, trace: Trace, episode: int, scene: Scene, fixed_s: FixedHorizons) -> None:
        self.trace, self.episode = trace, episode
        size_m = np.stack([trace.length_m[episode], trace.width_m[episode]], -1)
        self.yaw_rad = np.unwrap(trace.yaw_rad[:, episode], axis=0)
        color = planner_colors([trace.planner], fixed_s)[trace.planner]
        self.view = StreetView(axis, scene, size_m, color, planner_label(trace.planner, fixed_s))

    def artists_at(self, time_s: float) -> list[Artist]:
        """Move all parts to their places at a time and return them in drawing order."""
        end = self.trace.n_steps[self.episode]
        step = min(time_s / self.trace.dt_s, float(end))
        horizon_s = self.trace.horizon_s[min(int(step), end - 1), self.episode, EGO]
        is_over = bool(step >= end)
        return self.view.artists(
            Moment(
                step * self.trace.dt_s,
                *self._motion(step),
                horizon_s=np.nan if is_over else horizon_s,
                intervention=0 if is_over else int(self.trace.intervention[min(int(step), end - 1), self.episode]),
                outcome=OUTCOMES[self.trace.outcome[self.episode]] if is_over else None,
            )
        )

    def _motion(self, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position [V, 2], yaw [V], speed [V] between two decisions, interpolated linearly."""
        before = min(int(step), len(self.yaw_rad) - 2)
        share = step - before
        position = self.trace.position_m[before : before + 2, self.episode]
        speed = self.trace.speed_mps[before : before + 2, self.episode]
        yaw = self.yaw_rad[before : before + 2]
        return tuple((1 - share) * pair[0] + share * pair[1] for pair in (position, yaw, speed))  # type: ignore[return-value]


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
