"""The evaluate stage: the policy and the planners that it is compared with, on the same held-out tasks."""

import logging
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import pandas as pd

from negopipe.driver import MakeDriver
from negopipe.env import Game
from negopipe.errors import UserError
from negopipe.evaluation import metrics
from negopipe.evaluation.comparison import versus_adaptive
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.planners import adaptive_planner, by_horizon
from negopipe.evaluation.safety import safety
from negopipe.evaluation.trace import ADAPTIVE, Trace, save_traces
from negopipe.policy.actor_critic import ActorCritic
from negopipe.seeding import generator
from negopipe.simulation.scenario import TaskSampler, pair_styles
from negopipe.simulation.state import Task, map_tensors
from negopipe.stages.progress import ProgressLine
from negopipe.stages.setup import build, device_of, load_policy
from negopipe.tracking.checkpoint import CHECKPOINT_NAME, find_checkpoint

if TYPE_CHECKING:
    from pathlib import Path

    from negopipe.config import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")


class _Planner(NamedTuple):
    """Who is evaluated. n_episodes: on the first so many tasks, None = all; is_in_step: see `drive_episodes`."""

    make_ego: MakeDriver
    n_episodes: int | None = None
    is_in_step: bool = False


def run(config: "RunConfig", run: "TrackedRun") -> None:
    """Drive every planner through every setting; writes episodes.csv, traces.npz and metrics.json."""
    checkpoint = _checkpoint(config, run)
    game, policy = build(config)
    load_policy(checkpoint, policy, config)
    planners = _planners(config, game, policy)
    traces, tables = [], []
    with ProgressLine("evaluate", len(planners) * len(config.evaluation.settings)) as progress:
        for setting in config.evaluation.settings:
            tasks = held_out_tasks(config, game, setting)
            for name, planner in planners.items():
                trace = _drive(config, game, planner, tasks, (name, setting))
                tables.append(_rows(config, trace))
                traces.append(trace.first(config.evaluation.n_traced))
                progress.advance(f"{setting}, {name}")
    table = pd.concat(tables, ignore_index=True)
    table.to_csv(run.folder / "episodes.csv", index=False)
    save_traces(run.folder / "traces.npz", traces)
    summary = metrics.summary(table)
    run.update_metrics_json(summary | versus_adaptive(table))
    run.log_artifact(run.folder / "episodes.csv")
    run.log_metrics(_scalars(summary), step=0)
    _say(summary)


def _planners(config: "RunConfig", game: Game, policy: ActorCritic) -> dict[str, _Planner]:
    """The policy and its rivals, by name."""
    is_drawn = config.evaluation.action == "sample"
    sampling = generator(config.seed, "evaluation actions", device_of(config)) if is_drawn else None
    choose = adaptive_planner(policy, game, config.policy.horizons_s, sampling)
    rivals = {
        name: _Planner(partial(rival.driver, game), rival.n_episodes, rival.is_in_step)
        for name, rival in config.evaluation.rivals.items()
    }
    return {ADAPTIVE: _Planner(by_horizon(game, choose)), **rivals}


def _drive(config: "RunConfig", game: Game, planner: _Planner, tasks: Task, names: tuple[str, str]) -> Trace:
    driven = map_tensors(lambda field: field[: planner.n_episodes], tasks)
    n_worlds, paid = config.evaluation.n_worlds, config.evaluation.reward
    return drive_episodes(game, planner.make_ego, driven, n_worlds, paid, names, planner.is_in_step)


def held_out_tasks(config: "RunConfig", game: Game, setting: str) -> Task:
    """The setting's tasks, the same for every planner and training seed; training draws from other streams."""
    stream = generator(config.evaluation.task_seed, f"held-out tasks {setting}", game.planner.times.device)
    families = pair_styles(config.scenario.families, config.scenario.pairing)
    return TaskSampler(config.scenario, {setting: families[setting]}, stream).draw(config.evaluation.n_episodes)


def _rows(config: "RunConfig", trace: Trace) -> pd.DataFrame:
    """All that is measured, one row per episode."""
    driven = metrics.episodes(trace, config.scenario.road.corridor_length_m)
    return driven.join(safety(trace, config.scenario.vehicle, config.planner.limits.full_braking_mps2))


def _checkpoint(config: "RunConfig", run: "TrackedRun") -> "Path":
    """What this run trained, or else what `checkpoint` names."""
    own = run.folder / CHECKPOINT_NAME
    if own.is_file() and (config.checkpoint is None or "train" in config.stages):
        return own
    if config.checkpoint is None:
        raise UserError(
            "checkpoint must be a file or an MLflow run id where stages leaves out train and the run folder "
            f"has no {CHECKPOINT_NAME}, got null"
        )
    return find_checkpoint(config.checkpoint, config)


def _scalars(summary: dict) -> dict[str, float]:
    return {
        f"evaluation/{setting}/{planner}/{measure}": float(value)
        for setting, planners in summary["evaluation"].items()
        for planner, measures in planners.items()
        for measure, value in measures.items()
        if value is not None
    }


def _say(summary: dict) -> None:
    """The result as a table on the terminal."""
    for setting, planners in summary["evaluation"].items():
        log.info(f"{setting:10} {'success':>8} {'collision':>10} {'timeout':>8} {'time':>8} {'reward':>8}")
        for planner, m in planners.items():
            time = "-" if m["driving_time_s"] is None else f"{m['driving_time_s']:.1f} s"
            log.info(
                f"  {planner:8} {m['success_rate']:8.1%} {m['collision_rate']:10.1%} {m['timeout_rate']:8.1%} "
                f"{time:>8} {m['reward']:8.2f}"
            )
