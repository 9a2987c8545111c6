"""The report stage: from the files of an evaluated run to figures, animations and report.html."""

import logging
from collections.abc import Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import pandas as pd
import torch

from negopipe.evaluation.claims import judge_claims
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.replay import PolicyTrace, record_policy
from negopipe.evaluation.trace import ADAPTIVE, TRACES_NAME, Trace, load_traces
from negopipe.report.captions import WATCH
from negopipe.report.headlines import headlines
from negopipe.report.page import Results, Section, build_page, chapters, settings_in_order
from negopipe.report.provenance import provenance, write_claims
from negopipe.report.run_files import RESULTS, adaptive_of, by_setting, in_order, pick, read_metrics
from negopipe.report.scene import scene_of
from negopipe.report.sections import (
    FigureWriter,
    behaviour_section,
    film_items,
    filmed_alone,
    negotiations_section,
    planners_section,
    streets_sections,
    training_section,
    unseen_distances,
)
from negopipe.runtime.build import build, load_weights
from negopipe.simulation.build_road import build_road
from negopipe.simulation.state import EGO
from negopipe.stages.behaviour_map import MAP_NAME
from negopipe.stages.evaluate import checkpoint_of
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.csv_file import read_csv

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

N_TABLED = 100
"""Episodes of each planner and setting in the store's table; episodes.csv has all."""


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Write claims.json, figures/, animations/ and report.html into the run folder and log them as artifacts.

    Raises UserError if a file of an earlier stage is missing, or if the planners were evaluated on different tasks.
    """
    metrics = read_metrics(tracked.folder)
    settings = settings_in_order(metrics["evaluation"], config.evaluation.leading_setting)
    shown = [ADAPTIVE, *config.report.side_by_side]
    traces = by_setting(load_traces(tracked.folder / TRACES_NAME), settings, shown)
    table = in_order(read_csv(tracked.folder / EPISODES_NAME, EPISODES, EPISODES.columns), settings)
    planners = list(table["planner"].unique())
    results = Results(*({setting: pick(metrics[part][setting], planners) for setting in settings} for part in RESULTS))
    fixed_s = config.evaluation.fixed_horizons_s
    claims = judge_claims(table, [trace for group in traces.values() for trace in group], fixed_s)
    write_claims(tracked, claims)
    drawings = FigureWriter(tracked.folder / "figures", config.report.figure_formats)
    films = FigureWriter(tracked.folder / "animations")
    road = build_road(config.scenario)
    policy_traces = record_policies(config, tracked, traces)
    log.info("report: figures")
    scene = partial(scene_of, road, plan_s=config.planner.horizon_s)
    items = film_items(config.report, films, traces, scene, policy_traces, fixed_s)
    opening, others = (items[0], items[1:]) if items else (None, [])
    sections = [
        planners_section(drawings, table, unseen_distances(config), fixed_s),
        negotiations_section(drawings, traces, fixed_s),
        *([Section("Animations", WATCH, others)] if others else []),
        behaviour_section(drawings, traces, tracked.folder / MAP_NAME, fixed_s),
        *streets_sections(drawings, config.scenario, road, config.report.n_streets),
        training_section(
            drawings, films, tracked, sorted({gap for gaps in unseen_distances(config).values() for gap in gaps})
        ),
    ]
    verdicts = headlines(results.evaluation, results.versus, fixed_s)
    title = f"{config.name}, seed {config.seed}"
    tested = claims if any(claim.verdict != "not tested" for claim in claims) else []
    origin = provenance(config.seed, tracked)
    page = build_page(title, verdicts, chapters(results, fixed_s), tested, sections, origin, opening)
    (tracked.folder / "report.html").write_text(page, encoding="utf-8")
    _log(tracked, (drawings, films))
    _log_tables(tracked, metrics, table)
    log.info("report: %s", tracked.folder / "report.html")


def _log(tracked: "TrackedRun", writers: Iterable[FigureWriter]) -> None:
    """Log figures, animations and the page as artifacts."""
    for writer in writers:
        if any(writer.folder.iterdir()):
            tracked.log_artifact(writer.folder, writer.folder.name)
    tracked.log_artifact(tracked.folder / "report.html")


def record_policies(
    config: "RunConfig", run: "TrackedRun", traces: Mapping[str, list[Trace]]
) -> dict[str, dict[int, PolicyTrace]]:
    """Setting -> episode -> inputs and outputs of the policy, of the episodes that are shown alone. They are replayed
    with the recorded horizons."""
    shown = {
        setting: list(filmed_alone(config.report, adaptive_of(group)).values()) for setting, group in traces.items()
    }
    if not any(shown.values()):
        return {}
    log.info("report: replay of the policy")
    game, policy = build(config)
    load_weights(checkpoint_of(config, run), policy, config)
    policy_traces = {}
    for setting, episodes in shown.items():
        adaptive, tasks = adaptive_of(traces[setting]), held_out_tasks(config, game, setting)
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


def _log_tables(run: "TrackedRun", metrics: Mapping[str, Any], episodes: pd.DataFrame) -> None:
    """Log the measures and the first episodes as tables of the dashboard."""
    measures = [
        {"setting": setting, "planner": planner} | values
        for setting, planners in metrics["evaluation"].items()
        for planner, values in planners.items()
    ]
    run.log_table("planners", pd.DataFrame(measures))
    first = episodes[episodes["episode"] < N_TABLED]
    run.log_table("episodes", first.drop(columns="horizons"))
