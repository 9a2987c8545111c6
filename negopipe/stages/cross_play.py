"""The cross-play stage: every driver of the population in both seats against every driver of it."""

from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import pandas as pd

from negopipe.agents.population import LeagueDriver, SelfDriver
from negopipe.evaluation.cross_play import CROSS_PLAY, cell, symmetric
from negopipe.evaluation.episodes import by_cast, drive_episodes, warm_up
from negopipe.evaluation.episodes_file import Drives
from negopipe.game.game import Game
from negopipe.report.cross_play_figure import cross_play
from negopipe.report.figures import render
from negopipe.runtime.build import build, game_of, load_weights
from negopipe.runtime.progress import ProgressLine
from negopipe.runtime.workers import n_processes, side_by_side
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import Task
from negopipe.stages.evaluate import checkpoint_of
from negopipe.tensors.seeding import generator
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.csv_file import write_csv

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

TABLE_NAME = "cross_play.csv"

Pair = tuple[str, str, str]
"""Setting, driver of the ego, driver of the social vehicles."""


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Drive all pairs in all settings; writes cross_play.csv and figures/cross_play_<setting>.*."""
    table = drive_pairs(config, _game(config, tracked))
    write_csv(tracked.folder / TABLE_NAME, table, CROSS_PLAY)
    tracked.log_artifact(tracked.folder / TABLE_NAME)
    folder = tracked.folder / "figures"
    folder.mkdir(exist_ok=True)
    for (setting, rows), format_ in product(table.groupby("setting", sort=False), config.report.figure_formats):
        path = folder / f"cross_play_{setting}.{format_}"
        path.write_bytes(render(cross_play(rows), format_))
        tracked.log_artifact(path, folder.name)


def drive_pairs(config: "RunConfig", game: Game) -> pd.DataFrame:
    """One row of `negopipe.evaluation.cross_play.cell` per setting, driver of the ego and driver of the others."""
    pairs: list[Pair] = list(product(config.evaluation.settings, players(game), players(game)))
    n = n_processes(config.device, int(config.n_threads))
    if n > 1:  # compile before processes are forked
        warm_up(game, by_cast, map_tensors(lambda field: field[:1], pair_tasks(config, game, pairs[0])))
    with ProgressLine("cross-play", len(pairs)) as progress:

        def say(index: int) -> None:
            setting, ego, social = pairs[index]
            progress.advance(f"{setting}, {ego} meets {social}")

        return pd.DataFrame(side_by_side([partial(_drive, config, game, pair) for pair in pairs], n, say))


def players(game: Game) -> list[str]:
    """Names of the drivers with a weight."""
    return [name for name, weight in zip(game.cast.names, game.cast.weights.tolist(), strict=True) if weight > 0]


def pair_tasks(config: "RunConfig", game: Game, pair: Pair) -> Task:
    """The setting's held-out tasks with the drivers of the pair; the starts are the same for every pair."""
    setting, ego, social = pair
    stream = generator(config.evaluation.task_seed, f"held-out tasks {setting}", game.planner.times.device)
    families = {setting: config.scenario.families[setting]}
    drawn = TaskSampler(config.scenario, families, stream).draw(config.cross_play.n_episodes)
    if config.cross_play.is_symmetric:
        drawn = symmetric(drawn)
    names = game.cast.names
    return game.cast.only(names.index(social)).assign(drawn, names.index(ego))


def _game(config: "RunConfig", tracked: "TrackedRun") -> Game:
    """The game, with the run's policy where the population asks for it."""
    if not any(isinstance(each.driver, SelfDriver | LeagueDriver) for each in config.population.drivers.values()):
        return game_of(config)
    game, policy = build(config)
    load_weights(checkpoint_of(config, tracked), policy, config)
    return game


def _drive(config: "RunConfig", game: Game, pair: Pair) -> dict[str, Any]:
    setting, ego, social = pair
    n_worlds, paid = config.evaluation.n_worlds, config.evaluation.reward
    trace = drive_episodes(game, by_cast, pair_tasks(config, game, pair), n_worlds, paid, (ego, setting))
    return cell(Drives.of(config, trace), ego, social)
