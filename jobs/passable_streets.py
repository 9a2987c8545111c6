"""Drives of `cautious` on drawn streets that two planners resolve: python jobs/passable_streets.py <table.csv>

A task counts if an ego of style 2 s and a social vehicle of style 6 s, or the other way round, both arrive. On those
tasks `cautious` drives against the styles of the mixture. Every task has a street of its own, but for chance. The table
has a row per style of the social vehicle and one for all; the tasks in which `cautious` fails are printed.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from negopipe import load_config
from negopipe.agents.driver import MakeDriver, fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.config.root import RunConfig
from negopipe.evaluation.behaviour_map import Opponent
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.game.game import Game
from negopipe.runtime.backend import prepare
from negopipe.runtime.build import game_of
from negopipe.simulation.state import Task
from negopipe.stages.behaviour_map import map_tasks
from negopipe.tracking.csv_file import CsvKind, write_csv

SETTING, EGO_NAME = "mixture", "cautious"
TABLE = CsvKind("jobs/passable_streets.py", {"style_s": str, "n_tasks": int, "*_rate": float})
STYLES_S = (2.0, 6.0)


def config_of(n_tasks: int, overrides: Sequence[str]) -> RunConfig:
    """The mixture on as many drawn streets as there are tasks."""
    return load_config(
        "+experiment=mixture",
        "device=cpu",
        "compile=off",
        "n_threads=1",
        "scenario=random_streets",
        "curriculum=streets",
        "planner=consistent_stops",
        f"evaluation/baseline=[{EGO_NAME}]",
        "evaluation.oracle=null",
        "report.side_by_side=[]",
        "scenario.streets.n_training=1",
        f"scenario.streets.n_held_out={n_tasks}",
        f"evaluation.n_episodes={n_tasks}",
        f"behaviour_map.n_episodes={n_tasks}",
        *overrides,
    )


def drive(config: RunConfig, game: Game, ego: MakeDriver, tasks: Task, name: str, is_lockstep: bool = False) -> Trace:
    paid, n_worlds = config.evaluation.reward, config.evaluation.n_worlds
    return drive_episodes(game, ego, tasks, n_worlds, paid, (name, SETTING), is_lockstep)


def driven(config: RunConfig, game: Game) -> pd.DataFrame:
    """A row per task: street, start and style of the social vehicle, outcomes of `cautious` and of both planners."""
    baseline = config.evaluation.baselines[EGO_NAME]
    tasks = held_out_tasks(config, game, SETTING)
    trace = drive(config, game, partial(baseline.driver, game), tasks, EGO_NAME, baseline.is_lockstep)
    columns = {
        "street": trace.street,
        "corridor_m": trace.corridor_m,
        "start_m": trace.start_distance_m[:, 1],
        "style_s": trace.style_horizon_s[:, 1],
        EGO_NAME: np.array(OUTCOMES)[trace.outcome],
    }
    for own_s, other_s in (STYLES_S, STYLES_S[::-1]):
        ego = by_horizon(game, fixed_horizon(own_s))
        same = drive(config, game, ego, map_tasks(config, game, SETTING, Opponent(other_s, "")), f"fixed_{own_s:g}")
        is_same = np.array_equal(same.street, trace.street)
        if not (is_same and np.allclose(same.start_distance_m, trace.start_distance_m)):
            raise ValueError("the planners must drive the tasks of the mixture, with styles of their own")
        columns[f"ego_{own_s:g}_social_{other_s:g}"] = np.array(OUTCOMES)[same.outcome]
    return pd.DataFrame(columns)


def summary(tasks: pd.DataFrame) -> pd.DataFrame:
    """Shares of the outcomes of `cautious` by style of the social vehicle, and of all."""
    groups = [("all", tasks), *((f"{style:g}", rows) for style, rows in tasks.groupby("style_s"))]
    return pd.DataFrame(
        {"style_s": style, "n_tasks": len(rows)}
        | {f"{outcome}_rate": round(float((rows[EGO_NAME] == outcome).mean()), 4) for outcome in OUTCOMES}
        for style, rows in groups
    )


def main(table: Path, n_tasks: int, overrides: Sequence[str]) -> None:
    config = config_of(n_tasks, overrides)
    prepare(config)
    tasks = driven(config, game_of(config))
    pairs = [f"ego_{own_s:g}_social_{other_s:g}" for own_s, other_s in (STYLES_S, STYLES_S[::-1])]
    is_resolved = (tasks[pairs] == "success").any(axis=1)
    passable = tasks[is_resolved]
    found = summary(passable)
    print(f"two planners resolve {len(passable)} of {n_tasks} tasks, on {passable['street'].nunique()} streets")
    print(found.to_string(index=False))
    failed = passable[passable[EGO_NAME] != "success"]
    print(failed.to_string() if len(failed) else f"{EGO_NAME} succeeds in all of them")
    write_csv(table, found, TABLE)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path, help="file of the table")
    parser.add_argument("--tasks", type=int, default=640, help="number of tasks and of streets")
    parser.add_argument("overrides", nargs="*", help="of the config, such as n_threads=4")
    args = parser.parse_args()
    main(args.table, args.tasks, args.overrides)
