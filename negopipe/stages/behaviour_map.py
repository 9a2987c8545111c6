"""The behaviour map: every fixed horizon of the ego against every style of the social driver, on the same tasks.

Drivers of the population that are no plain planners in the styles of the families are opponents as well.
"""

import logging
from dataclasses import replace
from functools import partial
from itertools import product
from math import nan
from typing import TYPE_CHECKING, Any

import pandas as pd

from negopipe.agents.driver import fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.agents.population import is_plain
from negopipe.evaluation.behaviour_map import BEHAVIOUR_MAP, Opponent, cell, claims, trends
from negopipe.evaluation.episodes import drive_episodes, warm_up
from negopipe.evaluation.episodes_file import Drives
from negopipe.evaluation.names import fixed_name, horizon_in_words
from negopipe.game.game import Game
from negopipe.report.figures import render
from negopipe.report.map_figure import behaviour_map, reading
from negopipe.runtime.build import game_of
from negopipe.runtime.progress import ProgressLine
from negopipe.runtime.workers import n_processes, side_by_side
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import Task
from negopipe.tensors.seeding import generator
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.csv_file import write_csv

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

MAP_NAME = "behaviour_map.csv"


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Drive all pairs in all settings; writes behaviour_map.csv, figures/behaviour_map.* and claim 8's verdicts."""
    game = game_of(config)
    table = drive_map(config, game)
    write_csv(tracked.folder / MAP_NAME, table, BEHAVIOUR_MAP)
    tracked.log_artifact(tracked.folder / MAP_NAME)
    _draw(table, config.report.figure_formats, tracked)
    found = trends(table)
    tracked.update_metrics_json({"behaviour_map": {"claims": claims(found)}})
    paragraph = reading(found)
    if "evaluate" not in config.stages:  # the evaluation has the longer description
        tracked.set_description(paragraph)
        log.info(paragraph)


def drive_map(config: "RunConfig", game: Game) -> pd.DataFrame:
    """One row of `negopipe.evaluation.behaviour_map.cell` per setting, opponent and horizon of the ego."""
    grid = config.behaviour_map
    pairs = list(product(config.evaluation.settings, opponents(config), grid.horizons_s))
    n = n_processes(config.device, int(config.n_threads))
    if n > 1:  # compile before processes are forked
        setting, opponent, horizon_s = pairs[0]
        first = map_tensors(lambda field: field[:1], map_tasks(config, game, setting, opponent))
        warm_up(game, by_horizon(game, fixed_horizon(horizon_s)), first)
    with ProgressLine("behaviour map", len(pairs)) as progress:

        def say(index: int) -> None:
            setting, opponent, horizon_s = pairs[index]
            whom = opponent.driver or horizon_in_words(opponent.style_s)
            progress.advance(f"{setting}, ego {horizon_in_words(horizon_s)}, social {whom}")

        return pd.DataFrame(side_by_side([partial(_drive, config, game, *pair) for pair in pairs], n, say))


def opponents(config: "RunConfig") -> list[Opponent]:
    """The mapped styles, then the drivers of the population that these do not cover."""
    drivers = config.population.drivers.items()
    named = [name for name, each in drivers if each.weight > 0 and not is_plain(each.driver)]
    return [*(Opponent(style_s, "") for style_s in config.behaviour_map.styles_s), *(Opponent(nan, n) for n in named)]


def map_tasks(config: "RunConfig", game: Game, setting: str, opponent: Opponent) -> Task:
    """The setting's held-out tasks, all social vehicles driven alike; the starts are the same for every opponent."""
    stream = generator(config.evaluation.task_seed, f"held-out tasks {setting}", game.planner.times.device)
    family, assign = config.scenario.families[setting], None
    if opponent.driver:
        assign = game.cast.only(game.cast.names.index(opponent.driver)).assign
    else:
        family = replace(family, style_horizon_s=[opponent.style_s], style_switch=None)
    return TaskSampler(config.scenario, {setting: family}, stream, assign).draw(config.behaviour_map.n_episodes)


def _drive(config: "RunConfig", game: Game, setting: str, opponent: Opponent, horizon_s: float) -> dict[str, Any]:
    tasks, ego = map_tasks(config, game, setting, opponent), by_horizon(game, fixed_horizon(horizon_s))
    n_worlds, paid = config.evaluation.n_worlds, config.evaluation.reward
    trace = drive_episodes(game, ego, tasks, n_worlds, paid, (fixed_name(horizon_s), setting))
    return cell(Drives.of(config, trace), horizon_s, opponent)


def _draw(table: pd.DataFrame, formats: tuple[str, ...], run: "TrackedRun") -> None:
    folder = run.folder / "figures"
    folder.mkdir(exist_ok=True)
    figure = behaviour_map(table)
    for format_ in formats:
        path = folder / f"behaviour_map.{format_}"
        path.write_bytes(render(figure, format_))
        run.log_artifact(path, folder.name)
