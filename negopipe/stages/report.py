"""The report stage: from the files of an evaluated run to figures, animations and report.html."""

import json
import logging
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from negopipe.errors import UserError
from negopipe.evaluation.behaviour_map import BEHAVIOUR_MAP, trends
from negopipe.evaluation.claims import judge_claims
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME
from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.replay import PolicyTrace, record_policy
from negopipe.evaluation.trace import ADAPTIVE, Trace, load_traces
from negopipe.report import animation, figures, outcome_figures
from negopipe.report.animation import Scene
from negopipe.report.captions import NOT_TRAINED, WATCH, caption
from negopipe.report.figures import planner_label, setting_label
from negopipe.report.headlines import headlines
from negopipe.report.map_figure import behaviour_map as map_figure
from negopipe.report.map_figure import reading as map_reading
from negopipe.report.page import FigureItem, ReportConfig, Results, Section, build_page, chapters, settings_in_order
from negopipe.report.provenance import provenance, write_claims
from negopipe.runtime.build import build, load_policy
from negopipe.simulation.road import Road
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.state import EGO, NEAREST, map_tensors
from negopipe.stages import report_runs
from negopipe.stages.behaviour_map import MAP_NAME
from negopipe.stages.evaluate import checkpoint_of, held_out_tasks
from negopipe.tracking.csv_file import read_csv
from negopipe.tracking.run_folder import HISTORY_NAME, TRAINING_EPISODES_NAME
from negopipe.training.learning_curve import HISTORY, TRAINING_EPISODES

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

RESULTS = ("evaluation", "versus_adaptive", "regret")
"""Parts of metrics.json that the page shows."""
DRAWN_OF_TRAINING = ("decisions", "is_success", "is_collision", "social_start_distance_m", "style_horizon_s")
N_TRAINING_MAPS, SLIDE_S = 10, 0.8
"""Parts that the training is shown in, and how long each is on screen."""
N_TABLED = 100
"""Episodes of each planner and setting in the store's table, which is for looking through; episodes.csv has all."""


class _FigureWriter:
    """Saves what is drawn into the run folder and hands it on as an item of the page."""

    def __init__(self, folder: Path, formats: Sequence[str] = ()) -> None:
        self.folder, self.formats = folder, formats
        shutil.rmtree(folder, ignore_errors=True)  # what an earlier report left there with other options
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


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Write claims.json, figures/, animations/ and report.html into the run folder and log them as artifacts.

    Raises UserError if a file that an earlier stage writes is missing, or if the planners that are shown side
    by side were not evaluated on the same tasks.
    """
    if config.runs is not None:
        return report_runs.run(config, tracked)
    metrics = _read_metrics(tracked.folder)
    settings = settings_in_order(metrics["evaluation"], config.evaluation.leading_setting)
    shown = [ADAPTIVE, *config.report.side_by_side]
    traces = _by_setting(load_traces(tracked.folder / "traces.npz"), settings, shown)
    table = _in_order(read_csv(tracked.folder / EPISODES_NAME, EPISODES, EPISODES.columns), settings)
    planners = list(table["planner"].unique())
    results = Results(*({setting: _pick(metrics[part][setting], planners) for setting in settings} for part in RESULTS))
    fixed_s = config.evaluation.fixed_horizons_s
    claims = judge_claims(table, [trace for group in traces.values() for trace in group], fixed_s)
    write_claims(tracked, claims)
    drawings = _FigureWriter(tracked.folder / "figures", config.report.figure_formats)
    films = _FigureWriter(tracked.folder / "animations")
    road = Road(config.scenario.road)
    policy_traces = record_policies(config, tracked, traces)
    log.info("report: figures")
    sections = [
        _planners(drawings, table, _unseen(config), fixed_s),
        _negotiations(drawings, traces, road.corridor_sigma_m, fixed_s),
        _animations(config.report, films, traces, make_scene(config.scenario, road), policy_traces, fixed_s),
        _behaviour(drawings, traces, config.scenario.road.corridor_length_m, tracked.folder / MAP_NAME, fixed_s),
        _training(drawings, films, tracked, sorted({gap for gaps in _unseen(config).values() for gap in gaps})),
    ]
    verdicts = headlines(results.evaluation, results.versus, fixed_s)
    title = f"{config.name}, seed {config.seed}"
    tested = claims if any(claim.verdict != "not tested" for claim in claims) else []
    page = build_page(title, verdicts, chapters(results, fixed_s), tested, sections, provenance(config.seed, tracked))
    (tracked.folder / "report.html").write_text(page, encoding="utf-8")
    for writer in (drawings, films):
        if any(writer.folder.iterdir()):
            tracked.log_artifact(writer.folder, writer.folder.name)
    tracked.log_artifact(tracked.folder / "report.html")
    _log_tables(tracked, metrics, table)
    log.info("report: %s", tracked.folder / "report.html")


def make_scene(scenario: ScenarioConfig, road: Road) -> Scene:
    """The road as plain arrays for drawing."""
    reach_m = 60.0 + scenario.road.corridor_length_m / 2
    kerbs = road.kerb_lines(-reach_m, reach_m)
    sigma = torch.linspace(-reach_m, reach_m, kerbs.shape[1])
    direction = torch.tensor([[1.0], [-1.0]])
    s = direction * sigma + scenario.road.corridor_length_m / 2
    return Scene(
        parked_cars=road.parked_cars.cpu().numpy(),
        line_m=torch.stack([sigma, *road.reference.pose(sigma)], -1).numpy(),
        kerbs_m=kerbs.numpy(),
        corridor_m=road.kerb_lines(*road.corridor_sigma_m).numpy(),
        route_d_m=(direction * road.route_offset(s, direction)[0]).numpy(),
        vehicle_length_m=scenario.vehicle.length_m,
        vehicle_width_m=scenario.vehicle.width_m,
    )


def _planners(
    writer: _FigureWriter,
    table: pd.DataFrame,
    unseen: Mapping[str, Sequence[tuple[float, float]]],
    fixed_s: FixedHorizons,
) -> Section:
    """Two settings share a figure at most: three would be too small to read on a phone."""
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
    has_styles = table.groupby("setting")["style_horizon_s"].transform("nunique") > 1
    if has_styles.any():
        drawing = outcome_figures.success_by_style(table[has_styles], fixed_s)
        items.append(writer.figure("success_by_style", drawing, *caption("success_by_style")))
    for setting, rows in table[has_styles].groupby("setting", sort=False):
        label, own = setting_label(str(setting)), rows[rows["planner"] == ADAPTIVE]
        drawing = outcome_figures.outcome_map(own, label, unseen.get(str(setting), ()))
        title, reading = caption("outcome_map", setting=label)
        items.append(writer.figure(f"outcome_map_{setting}", drawing, title, reading))
    return Section("Planners compared", "", items)


def _unseen(config: "RunConfig") -> dict[str, tuple[tuple[float, float], ...]]:
    """Start distances that the last stage of training left out, by the name of the family."""
    families = config.curriculum.stages[-1].families
    return {name: tuple((low, high) for low, high in family.gaps_m) for name, family in families.items()}


def _negotiations(
    writer: _FigureWriter,
    traces: dict[str, list[Trace]],
    corridor_sigma_m: tuple[float, float],
    fixed_s: FixedHorizons,
) -> Section:
    items = []
    for setting, group in traces.items():
        episode = _typical_of_all(group)
        drawing = figures.space_time(group, episode, corridor_sigma_m, fixed_s)
        title, reading = caption("space_time", setting=setting_label(setting))
        items.append(writer.figure(f"space_time_{setting}", drawing, title, reading))
    return Section("Negotiations", "", items)


def _typical_of_all(group: list[Trace]) -> int:
    """The policy's median episode among those that every planner drove."""
    return animation.choose_episodes(_adaptive(group).first(min(len(trace.n_steps) for trace in group)), 1)[0]


def _animations(
    report: ReportConfig,
    writer: _FigureWriter,
    traces: dict[str, list[Trace]],
    scene: Scene,
    policy_traces: Mapping[str, Mapping[int, PolicyTrace]],
    fixed_s: FixedHorizons,
) -> Section:
    """policy_traces: of the policy's episodes that are shown alone, by setting and episode."""
    items = []
    for setting, group in traces.items():
        adaptive = _adaptive(group)
        if report.side_by_side:
            compared = [adaptive, *_named(group, report.side_by_side)]
            name = f"{setting}_side_by_side"
            items.append(_film(writer, name, compared, _typical_of_all(group), scene, report.animation_fps, fixed_s))
        for name, episode in _shown_alone(report, adaptive).items():
            policy_trace = policy_traces[setting][episode]
            items.append(_film(writer, name, [adaptive], episode, scene, report.animation_fps, fixed_s, policy_trace))
    return Section("Watch it", WATCH, items)


def _shown_alone(report: ReportConfig, adaptive: Trace) -> dict[str, int]:
    """Name of the film -> episode of the adaptive planner: typical ones and the worst; none twice."""
    typical = animation.choose_episodes(adaptive, report.n_animations)
    named = {f"{adaptive.family}_{ADAPTIVE}_{rank}": episode for rank, episode in enumerate(typical, start=1)}
    worst = animation.worst_episode(adaptive)
    return named if worst in typical or not typical else named | {f"{adaptive.family}_{ADAPTIVE}_worst": worst}


def record_policies(
    config: "RunConfig", run: "TrackedRun", traces: Mapping[str, list[Trace]]
) -> dict[str, dict[int, PolicyTrace]]:
    """What the policy saw and thought in the episodes that are shown alone, by setting and episode: they are driven
    once more with the horizons of the record."""
    shown = {setting: list(_shown_alone(config.report, _adaptive(group)).values()) for setting, group in traces.items()}
    if not any(shown.values()):
        return {}
    log.info("report: looking into the policy")
    game, policy = build(config)
    load_policy(checkpoint_of(config, run), policy, config)
    policy_traces = {}
    for setting, episodes in shown.items():
        adaptive, tasks = _adaptive(traces[setting]), held_out_tasks(config, game, setting)
        which = torch.tensor(episodes, device=tasks.family.device)
        found = record_policy(
            game,
            policy,
            config.policy.horizons_s,
            config.observation.frame_interval_s,
            map_tensors(lambda field, i=which: field[i], tasks),
            [adaptive.horizon_s[: adaptive.n_steps[episode], episode, EGO] for episode in episodes],
            config.evaluation.reward,
        )
        policy_traces[setting] = dict(zip(episodes, found, strict=True))
    return policy_traces


def _film(
    writer: _FigureWriter,
    name: str,
    traces: list[Trace],
    episode: int,
    scene: Scene,
    fps: int,
    fixed_s: FixedHorizons,
    policy_trace: PolicyTrace | None = None,
) -> FigureItem:
    log.info("report: animation %s", name)
    trace = traces[0]
    gif = animation.animate(traces, episode, scene, fps, fixed_s, policy_trace)
    still = animation.still(traces, episode, scene, trace.n_steps[episode] * trace.dt_s / 3, fixed_s, policy_trace)
    title, reading = caption(
        "film" if policy_trace is None else "film_alone",
        setting=setting_label(trace.family),
        episode=episode,
        planners=", ".join(planner_label(shown.planner, fixed_s) for shown in traces),
        which="the worst" if name.endswith("_worst") else "a typical one",
        style_s=trace.style_horizon_s[episode, NEAREST],
    )
    return writer.animation(name, gif, still, title, reading)


def _behaviour(
    writer: _FigureWriter,
    traces: dict[str, list[Trace]],
    corridor_length_m: float,
    behaviour_map: Path,
    fixed_s: FixedHorizons,
) -> Section:
    """With the behaviour map, if its stage has left one."""
    flat = [trace for group in traces.values() for trace in group]
    along = figures.horizons_along(flat, corridor_length_m)
    items = [
        writer.figure("behaviour_index", figures.behaviour(flat, fixed_s), *caption("behaviour_index")),
        writer.figure("horizons", figures.horizons(flat), *caption("horizons")),
        writer.figure("horizons_along", along, *caption("horizons_along")),
    ]
    if behaviour_map.is_file():
        table = read_csv(behaviour_map, BEHAVIOUR_MAP, BEHAVIOUR_MAP.columns)
        words = caption("behaviour_map", verdict=map_reading(trends(table)))
        items.insert(0, writer.figure("behaviour_map", map_figure(table), *words))
    return Section("Behaviour", "", items)


def _training(
    drawings: _FigureWriter, films: _FigureWriter, run: "TrackedRun", unseen_m: Sequence[tuple[float, float]]
) -> Section:
    """The store is given the maps, too, each at the step at which its part of the training begins."""
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


def _read_metrics(folder: Path) -> dict[str, Any]:
    path = folder / "metrics.json"
    metrics = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    if not set(RESULTS) <= metrics.keys():
        raise UserError(f"{path}: no results of an evaluation; run the stage `evaluate` first")
    return metrics


def _pick(by_planner: Mapping[str, Any], planners: Sequence[str]) -> dict[str, Any]:
    """In the order of the planners; JSON has sorted them."""
    return {planner: by_planner[planner] for planner in planners if planner in by_planner}


def _log_tables(run: "TrackedRun", metrics: Mapping[str, Any], episodes: pd.DataFrame) -> None:
    """What the dashboard shows as tables, of one run or of several side by side."""
    measures = [
        {"setting": setting, "planner": planner} | values
        for setting, planners in metrics["evaluation"].items()
        for planner, values in planners.items()
    ]
    run.log_table("planners", pd.DataFrame(measures))
    first = episodes[episodes["episode"] < N_TABLED]
    run.log_table("episodes", first.drop(columns="horizons"))


def _in_order(table: pd.DataFrame, settings: list[str]) -> pd.DataFrame:
    """The rows of the leading setting first, planners as they come."""
    return pd.concat([table[table["setting"] == setting] for setting in settings], ignore_index=True)


def _by_setting(traces: list[Trace], settings: list[str], planners: Sequence[str]) -> dict[str, list[Trace]]:
    """Traces of each setting; `planners` must be among them."""
    grouped = {setting: [trace for trace in traces if trace.family == setting] for setting in settings}
    for group in grouped.values():
        _named(group, planners)
        _check_same_tasks(group)
    return grouped


def _check_same_tasks(group: list[Trace]) -> None:
    """One episode number must be one task for all planners, as far as they drove: they are shown side by side."""
    first = group[0]
    for trace in group[1:]:
        own, other = (each.first(min(len(trace.n_steps), len(first.n_steps))) for each in (trace, first))
        is_same = np.array_equal(own.start_distance_m, other.start_distance_m) and np.array_equal(
            own.style_horizon_s, other.style_horizon_s, equal_nan=True
        )
        if not is_same:
            planners = f"{first.planner} and {trace.planner}"
            raise UserError(f"traces.npz: {planners} drove different tasks in {first.family}; evaluate them anew")


def _adaptive(group: list[Trace]) -> Trace:
    return _named(group, [ADAPTIVE])[0]


def _named(group: list[Trace], planners: Sequence[str]) -> list[Trace]:
    by_name = {trace.planner: trace for trace in group}
    for planner in planners:
        if planner not in by_name:
            known = ", ".join(by_name) or "none"
            raise UserError(f"the report shows planner {planner}, but traces.npz holds only: {known}")
    return [by_name[planner] for planner in planners]
