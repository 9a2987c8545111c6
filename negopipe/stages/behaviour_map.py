"""The behaviour map: every fixed horizon of the ego against every style of the social driver, on the same tasks."""

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import pandas as pd

from negopipe.driver import fixed_horizon
from negopipe.env import Game
from negopipe.evaluation.behaviour_map import cell, claims, findings
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.planners import by_horizon, fixed_name
from negopipe.evaluation.trace import Trace
from negopipe.report.behaviour_map import behaviour_map, reading
from negopipe.report.figures import render
from negopipe.seeding import generator
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import Task
from negopipe.stages.backend import one_thread
from negopipe.stages.progress import ProgressLine
from negopipe.stages.setup import game_of

if TYPE_CHECKING:
    from negopipe.config import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")


def run(config: "RunConfig", run: "TrackedRun") -> None:
    """Drive all pairs in all settings; writes behaviour_map.csv, figures/behaviour_map.* and claim 8's verdicts."""
    game = game_of(config)
    table = drive_map(config, game)
    table.to_csv(run.folder / "behaviour_map.csv", index=False)
    run.log_artifact(run.folder / "behaviour_map.csv")
    _draw(table, config.report.figure_formats, run)
    found = findings(table)
    run.update_metrics_json({"behaviour_map": {"claims": claims(found)}})
    paragraph = reading(found)
    run.set_description(paragraph)
    log.info(paragraph)


def drive_map(config: "RunConfig", game: Game) -> pd.DataFrame:
    """One row of `negopipe.evaluation.behaviour_map.cell` per setting, ego horizon and social style."""
    grid, scenario = config.behaviour_map, config.scenario
    settings = config.evaluation.settings
    rows = []
    with ProgressLine("behaviour map", len(settings) * len(grid.styles_s) * len(grid.horizons_s)) as progress:
        for setting in settings:
            for style_s in grid.styles_s:
                tasks = map_tasks(config, game, setting, style_s)
                for horizon_s in grid.horizons_s:
                    trace = _drive(config, game, tasks, horizon_s, setting)
                    rows.append(cell(trace, horizon_s, style_s, scenario.road.corridor_length_m, scenario.vehicle))
                    progress.advance(f"{setting}, ego {horizon_s:g} s, social {style_s:g} s")
    return pd.DataFrame(rows)


def map_tasks(config: "RunConfig", game: Game, setting: str, style_s: float) -> Task:
    """The setting's held-out tasks, all social drivers in one style; the starts are the same for every style."""
    stream = generator(config.evaluation.task_seed, f"held-out tasks {setting}", game.planner.times.device)
    family = config.scenario.families[setting]
    in_one_style = replace(family, style_horizon_s=[style_s], style_switch=None)
    return TaskSampler(config.scenario, {setting: in_one_style}, stream).draw(config.behaviour_map.n_episodes)


@one_thread()
def _drive(config: "RunConfig", game: Game, tasks: Task, horizon_s: float, setting: str) -> Trace:
    names = (fixed_name(horizon_s), setting)
    return drive_episodes(
        game,
        by_horizon(game, fixed_horizon(horizon_s)),
        tasks,
        config.evaluation.n_worlds,
        config.evaluation.reward,
        names,
    )


def _draw(table: pd.DataFrame, formats: tuple[str, ...], run: "TrackedRun") -> None:
    folder = run.folder / "figures"
    folder.mkdir(exist_ok=True)
    figure = behaviour_map(table)
    for format_ in formats:
        path = folder / f"behaviour_map.{format_}"
        path.write_bytes(render(figure, format_))
        run.log_artifact(path, folder.name)
