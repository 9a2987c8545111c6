"""The sections of the report with their figures and animations."""

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from negopipe.evaluation.replay import PolicyTrace
from negopipe.evaluation.trace import ADAPTIVE, Trace
from negopipe.report.run_files import adaptive_of
from negopipe.report.scene import SceneOf
from negopipe.report.street_figures import street_maps
from negopipe.simulation.road import Road
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.tracking.csv_file import read_csv

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from negopipe.evaluation.behaviour_map import BEHAVIOUR_MAP, NEEDED, trends
from negopipe.evaluation.names import FixedHorizons
from negopipe.report import animation, figures, outcome_figures
from negopipe.report.captions import NOT_TRAINED, caption
from negopipe.report.labels import horizon_label, planner_label, setting_label
from negopipe.report.map_figure import behaviour_map as map_figure
from negopipe.report.map_figure import reading as map_reading
from negopipe.report.outcome_figures import opponent
from negopipe.report.page import FigureItem, ReportConfig, Section
from negopipe.report.run_files import named
from negopipe.simulation.state import NEAREST
from negopipe.tracking.run_folder import HISTORY_NAME, TRAINING_EPISODES_NAME
from negopipe.tracking.training_files import HISTORY, TRAINING_EPISODES

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

DRAWN_OF_TRAINING = ("decisions", "is_success", "is_collision", "social_start_distance_m", "style_horizon_s")
N_TRAINING_MAPS, SLIDE_S = 10, 0.8
"""Parts into which the training is divided, and the time that each is on screen."""


class FigureWriter:
    """Writer of figures and animations into the run folder, which returns them as items of the page."""

    def __init__(self, folder: Path, formats: Sequence[str] = ()) -> None:
        self.folder, self.formats = folder, formats
        shutil.rmtree(folder, ignore_errors=True)  # files of an earlier report with other options
        folder.mkdir()

    def figure(self, name: str, figure: Figure, title: str, reading: str) -> FigureItem:
        svg = figures.render(figure, "svg")
        for format_ in self.formats:
            data = svg if format_ == "svg" else figures.render(figure, format_)
            (self.folder / f"{name}.{format_}").write_bytes(data)
        return FigureItem(title, reading, svg)

    def animation(self, name: str, gif: bytes, still: bytes, title: str, reading: str) -> FigureItem:
        (self.folder / f"{name}.gif").write_bytes(gif)
        (self.folder / f"{name}.png").write_bytes(still)
        return FigureItem(title, reading, gif, still)


def planners_section(
    writer: FigureWriter,
    table: pd.DataFrame,
    unseen: Mapping[str, Sequence[tuple[float, float]]],
    fixed_s: FixedHorizons,
) -> Section:
    """Figures of all planners; at most two settings share a figure, so that it is legible on a phone."""
    settings = list(table["setting"].unique())
    items = []
    for pair in (settings[i : i + 2] for i in range(0, len(settings), 2)):
        title, reading = caption(
            "comparison", settings=" and ".join(setting_label(setting).lower() for setting in pair)
        )
        drawing = figures.comparison(table[table["setting"].isin(pair)], fixed_s)
        items.append(writer.figure(f"comparison_{'_'.join(pair)}", drawing, title, reading))
    items.append(writer.figure("outcomes", outcome_figures.outcomes(table, fixed_s), *caption("outcomes")))
    items.append(writer.figure("arrivals", outcome_figures.arrivals(table, fixed_s), *caption("arrivals")))
    has_styles = table.assign(met=opponent(table)).groupby("setting")["met"].transform("nunique") > 1
    if has_styles.any():
        drawing = outcome_figures.success_by_style(table[has_styles], fixed_s)
        items.append(writer.figure("success_by_style", drawing, *caption("success_by_style")))
    for setting, rows in table[has_styles].groupby("setting", sort=False):
        label, own = setting_label(str(setting)), rows[rows["planner"] == ADAPTIVE]
        drawing = outcome_figures.outcome_map(own, label, unseen.get(str(setting), ()))
        title, reading = caption("outcome_map", setting=label)
        items.append(writer.figure(f"outcome_map_{setting}", drawing, title, reading))
    return Section("Planners compared", "", items)


def unseen_distances(config: "RunConfig") -> dict[str, tuple[tuple[float, float], ...]]:
    """Family -> start distances that the last stage of training left out."""
    families = config.curriculum.stages[-1].families
    return {name: tuple((low, high) for low, high in family.gaps_m) for name, family in families.items()}


def negotiations_section(
    writer: FigureWriter,
    traces: dict[str, list[Trace]],
    fixed_s: FixedHorizons,
) -> Section:
    items = []
    for setting, group in traces.items():
        episode = _typical_of_all(group)
        drawing = figures.space_time(group, episode, fixed_s)
        title, reading = caption("space_time", setting=setting_label(setting))
        items.append(writer.figure(f"space_time_{setting}", drawing, title, reading))
    return Section("Negotiations", "", items)


def _typical_of_all(group: list[Trace]) -> int:
    """The policy's median episode among those driven by every planner."""
    return animation.choose_episodes(adaptive_of(group).first(min(len(trace.n_steps) for trace in group)), 1)[0]


def film_items(
    report: ReportConfig,
    writer: FigureWriter,
    traces: dict[str, list[Trace]],
    scene_of: SceneOf,
    policy_traces: Mapping[str, Mapping[int, PolicyTrace]],
    fixed_s: FixedHorizons,
) -> list[FigureItem]:
    """Animations of the settings in their order: side by side with other planners first, then the policy alone.

    policy_traces: setting -> episode -> inputs and outputs of the policy, of the episodes that are shown alone
    """
    items = []
    for setting, group in traces.items():
        adaptive = adaptive_of(group)
        if report.side_by_side:
            compared = [adaptive, *named(group, report.side_by_side)]
            name = f"{setting}_side_by_side"
            items.append(_film(writer, name, compared, _typical_of_all(group), scene_of, report.animation_fps, fixed_s))
        for name, episode in filmed_alone(report, adaptive).items():
            policy_trace = policy_traces[setting][episode]
            items.append(
                _film(writer, name, [adaptive], episode, scene_of, report.animation_fps, fixed_s, policy_trace)
            )
    return items


def filmed_alone(report: ReportConfig, adaptive: Trace) -> dict[str, int]:
    """Name of the animation -> episode of the adaptive planner: typical ones and the worst, none twice."""
    typical = animation.choose_episodes(adaptive, report.n_animations)
    named = {f"{adaptive.setting}_{ADAPTIVE}_{rank}": episode for rank, episode in enumerate(typical, start=1)}
    worst = animation.worst_episode(adaptive)
    return named if worst in typical or not typical else named | {f"{adaptive.setting}_{ADAPTIVE}_worst": worst}


def _film(
    writer: FigureWriter,
    name: str,
    traces: list[Trace],
    episode: int,
    scene_of: SceneOf,
    fps: int,
    fixed_s: FixedHorizons,
    policy_trace: PolicyTrace | None = None,
) -> FigureItem:
    log.info("report: animation %s", name)
    trace = traces[0]
    scene = scene_of(int(trace.street[episode]))
    gif = animation.animate(traces, episode, scene, fps, fixed_s, policy_trace)
    still = animation.still(traces, episode, scene, trace.n_steps[episode] * trace.dt_s / 3, fixed_s, policy_trace)
    title, reading = caption(
        "film" if policy_trace is None else "film_alone",
        setting=setting_label(trace.setting),
        episode=episode,
        planners=", ".join(planner_label(shown.planner, fixed_s) for shown in traces),
        which="lowest return" if name.endswith("_worst") else "typical",
        style=_style_text(trace, episode),
    )
    return writer.animation(name, gif, still, title, reading)


def _style_text(trace: Trace, episode: int) -> str:
    """How the nearest social vehicle drives: `style 6 s`, or the driver's name where it has no style."""
    style_s = trace.style_horizon_s[episode, NEAREST]
    return str(trace.driver[episode, NEAREST]) if np.isnan(style_s) else f"style {horizon_label(style_s)}"


def streets_sections(writer: FigureWriter, scenario: ScenarioConfig, road: Road, n: int) -> list[Section]:
    """Maps of the streets, where there are several; n: streets shown of each kind."""
    if road.n_streets == 1:
        return []
    maps = street_maps(scenario, road, n)
    return [Section("Streets", "", [writer.figure(name, drawn, *caption(name)) for name, drawn in maps.items()])]


def behaviour_section(
    writer: FigureWriter,
    traces: dict[str, list[Trace]],
    behaviour_map: Path,
    fixed_s: FixedHorizons,
) -> Section:
    """With the behaviour map, if its stage has left one."""
    flat = [trace for group in traces.values() for trace in group]
    along = figures.horizons_along(flat)
    items = [
        writer.figure("behaviour_index", figures.behaviour(flat, fixed_s), *caption("behaviour_index")),
        writer.figure("horizons", figures.horizons(flat), *caption("horizons")),
        writer.figure("horizons_along", along, *caption("horizons_along")),
    ]
    if behaviour_map.is_file():
        table = read_csv(behaviour_map, BEHAVIOUR_MAP, NEEDED)
        words = caption("behaviour_map", verdict=map_reading(trends(table)))
        items.insert(0, writer.figure("behaviour_map", map_figure(table), *words))
    return Section("Behaviour", "", items)


def training_section(
    drawings: FigureWriter, films: FigureWriter, run: "TrackedRun", unseen_m: Sequence[tuple[float, float]]
) -> Section:
    """Learning curves, and maps of outcomes, which are also logged at the steps at which their parts begin."""
    if not (run.folder / HISTORY_NAME).is_file():
        return Section("Training", NOT_TRAINED, [])
    table = read_csv(run.folder / HISTORY_NAME, HISTORY, ("decisions", "stage"))
    title, reading = caption("training", stages=", ".join(table["stage"].unique()))
    curves = drawings.figure("training", figures.training(table), title, reading)
    episodes = read_csv(run.folder / TRAINING_EPISODES_NAME, TRAINING_EPISODES, DRAWN_OF_TRAINING)
    if episodes.empty:
        return Section("Training", "", [curves])
    maps, folder = [], drawings.folder / "training_outcomes"
    folder.mkdir()
    for decisions, drawing in outcome_figures.training_maps(episodes, unseen_m, N_TRAINING_MAPS):
        maps.append(figures.render(drawing, "png"))
        path = folder / f"{decisions}.png"
        path.write_bytes(maps[-1])
        run.log_image(path, "training outcomes", decisions)
    film = animation.slides(maps, SLIDE_S)
    mastered = films.animation("training_outcomes", film, maps[-1], *caption("training_outcomes"))
    return Section("Training", "", [curves, mastered])
