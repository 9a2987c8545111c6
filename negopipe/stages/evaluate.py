"""The evaluate stage: the policy and its baselines on the same held-out tasks."""

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from torch import Tensor

from negopipe.agents.driver import HorizonDriver, MakeDriver
from negopipe.agents.driver_config import DriverConfig
from negopipe.agents.horizon_drivers import adaptive_planner
from negopipe.errors import UserError
from negopipe.evaluation import measures
from negopipe.evaluation.comparison import regret, versus_adaptive
from negopipe.evaluation.episodes import drive_episodes, warm_up
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME, Drives, episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.trace import ADAPTIVE, ORACLE, TRACES_NAME, Trace, save_traces
from negopipe.game.game import Game
from negopipe.policy.actor_critic import ActorCritic
from negopipe.report.description import log_summary
from negopipe.report.model_card import write_model_card
from negopipe.runtime.build import build, load_weights
from negopipe.runtime.progress import ProgressLine
from negopipe.runtime.workers import n_processes, side_by_side
from negopipe.search.oracle_table import DOES_NOT_FIT, drive_oracle, read_oracle
from negopipe.simulation.state import Task
from negopipe.tensors.torch_settings import one_thread
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.checkpoint import CHECKPOINT_NAME, find_checkpoint
from negopipe.tracking.csv_file import write_csv

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

Driven = tuple[pd.DataFrame, Trace]
"""Rows of episodes.csv of one planner in one setting, and the record of the first episodes."""


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Drive every planner through every setting; writes episodes.csv, traces.npz and metrics.json."""
    checkpoint = checkpoint_of(config, tracked)
    game, policy = build(config)
    load_weights(checkpoint, policy, config)
    jobs = jobs_of(
        config, game, policy, {name: held_out_tasks(config, game, name) for name in config.evaluation.settings}
    )
    names = list(jobs)
    n = n_processes(config.device, int(config.n_threads))
    if n > 1:
        _warm_up(config, game, policy)
    with ProgressLine("evaluate", len(jobs)) as progress:
        done = side_by_side(list(jobs.values()), n, lambda index: progress.advance(", ".join(names[index])))
    for (setting, planner), driven in zip(names, done, strict=True):
        if driven is None:
            log.info(f"{setting:10} without {planner}: {DOES_NOT_FIT}")
    tables, traces = zip(*(driven for driven in done if driven is not None), strict=True)
    table = pd.concat(tables, ignore_index=True)
    write_csv(tracked.folder / EPISODES_NAME, table, EPISODES)
    save_traces(tracked.folder / TRACES_NAME, list(traces))
    results = results_of(table)
    summary = {"evaluation": results["evaluation"]}
    tracked.update_metrics_json(results)
    tracked.log_artifact(tracked.folder / EPISODES_NAME)
    tracked.log_metrics(charts(summary), step=0)
    log_summary(config, tracked, results)
    write_model_card(config, tracked, results["evaluation"])
    for line in (*terminal_table(summary), *intervention_lines(table)):
        log.info(line)


def results_of(table: pd.DataFrame) -> dict[str, Any]:
    """Parts of metrics.json, from the rows of episodes.csv."""
    return measures.summary(table) | versus_adaptive(table) | regret(table)


def jobs_of(
    config: "RunConfig", game: Game, policy: ActorCritic, tasks_of: Mapping[str, Task]
) -> dict[tuple[str, str], Callable[[], Driven | None]]:
    """(setting, planner) -> evaluation of the planner in the setting, on the tasks of each setting in their order."""
    oracle = None if config.evaluation.oracle is None else read_oracle(config.evaluation.oracle)
    jobs: dict[tuple[str, str], Callable[[], Driven | None]] = {}
    for setting, tasks in tasks_of.items():
        for name in (ADAPTIVE, *config.evaluation.baselines):
            drive = partial(_drive, config, game, policy, tasks, (name, setting))
            jobs[setting, name] = partial(_measured, config, drive)
        if oracle is not None and oracle.has(setting):
            drive_found = partial(drive_oracle, config, game, tasks, oracle, setting)
            jobs[setting, ORACLE] = partial(_measured, config, drive_found)
    return jobs


def _measured(config: "RunConfig", drive: Callable[[], Trace | None]) -> Driven | None:
    """Rows and record of a planner; None if it was not driven."""
    trace = drive()
    return None if trace is None else (measure(config, trace), trace.first(config.evaluation.n_traced))


def _warm_up(config: "RunConfig", game: Game, policy: ActorCritic) -> None:
    """Compile the code of all planners once, before processes are forked."""
    first = map_tensors(lambda field: field[:1], held_out_tasks(config, game, config.evaluation.settings[0]))
    warm_up(game, _adaptive(config, game, policy), first)
    for baseline in config.evaluation.baselines.values():
        warm_up(game, partial(baseline.driver, game), first)


def _drive(config: "RunConfig", game: Game, policy: ActorCritic, tasks: Task, names: tuple[str, str]) -> Trace:
    """The record of the planner names[0], the policy or a baseline."""
    if names[0] != ADAPTIVE:
        return drive_baseline(config, game, config.evaluation.baselines[names[0]], tasks, names)
    ego, n_worlds, paid = _adaptive(config, game, policy), config.evaluation.n_worlds, config.evaluation.reward
    return drive_episodes(game, ego, tasks, n_worlds, paid, names, is_lockstep=_is_drawn(config))


def _adaptive(config: "RunConfig", game: Game, policy: ActorCritic) -> MakeDriver:
    def ego(episode_key: Tensor) -> HorizonDriver:
        numbers = episode_key if _is_drawn(config) else None
        return HorizonDriver(adaptive_planner(policy, game, config.policy.horizons_s, numbers), game.plan)

    return ego


def _is_drawn(config: "RunConfig") -> bool:
    return config.evaluation.action == "sample"


@one_thread()
def drive_baseline(
    config: "RunConfig", game: Game, baseline: DriverConfig, tasks: Task, names: tuple[str, str]
) -> Trace:
    """The record of a baseline on the first tasks, as many as it drives."""
    driven = map_tensors(lambda field: field[: baseline.n_driven], tasks)
    n_worlds, paid = config.evaluation.n_worlds, config.evaluation.reward
    return drive_episodes(game, partial(baseline.driver, game), driven, n_worlds, paid, names, baseline.is_lockstep)


def measure(config: "RunConfig", trace: Trace) -> pd.DataFrame:
    """Rows of episodes.csv."""
    return episodes(Drives.of(config, trace))


def checkpoint_of(config: "RunConfig", run: "TrackedRun") -> Path:
    """The checkpoint of this run's training, else the one that `checkpoint` names."""
    own = run.folder / CHECKPOINT_NAME
    if own.is_file() and (config.checkpoint is None or "train" in config.stages):
        return own
    if config.checkpoint is None:
        raise UserError(
            "checkpoint must be a file or an MLflow run id where stages leaves out train and the run folder "
            f"has no {CHECKPOINT_NAME}, got null"
        )
    return find_checkpoint(config.checkpoint, config)


def charts(summary: Mapping[str, Any]) -> dict[str, float]:
    """`evaluation/<setting>/<planner>/<measure>` of the charted measures that have a value."""
    return {
        f"evaluation/{setting}/{planner}/{measure.name}": float(value)
        for setting, planners in summary["evaluation"].items()
        for planner, values in planners.items()
        for measure in measures.MEASURES
        if measure.is_charted and (value := values[measure.name]) is not None
    }


def intervention_lines(table: pd.DataFrame) -> list[str]:
    """Lines about the planners whose plans the safety layer replaced, from rows of episodes.csv."""
    sums = table.groupby(["setting", "planner"], sort=False)[["intervention_count", "n_decisions"]].sum()
    return [
        f"safety layer: {count} of {n} plans of {planner} in {setting} replaced"
        for (setting, planner), (count, n) in zip(sums.index, sums.itertuples(index=False), strict=True)
        if count > 0
    ]


def terminal_table(summary: Mapping[str, Any]) -> list[str]:
    """Lines of a table per setting, with a row per planner and a column per charted measure."""
    charted = [measure for measure in measures.MEASURES if measure.is_charted]
    lines = []
    for setting, planners in summary["evaluation"].items():
        lines.append(f"{setting:12}" + "".join(f"{measure.label:>14}" for measure in charted))
        for planner, values in planners.items():
            lines.append(f"  {planner:10}" + "".join(f"{m.text(values[m.name]):>14}" for m in charted))
    return lines
