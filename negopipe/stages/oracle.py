"""The oracle stage: the best sequence of horizons per held-out task, and what the fixed horizons do on the same."""

import logging
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch

from negopipe.driver import ChooseHorizon
from negopipe.env import Game, build_game
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.metrics import episodes, running, summary
from negopipe.evaluation.oracle import Rollouts, Sequences, best_simple, improve
from negopipe.evaluation.planners import fixed_name, fixed_planners, sequence_planner
from negopipe.evaluation.trace import ORACLE, Trace
from negopipe.seeding import generator
from negopipe.simulation.state import EGO, Task, map_tensors
from negopipe.stages.evaluate import held_out_tasks
from negopipe.stages.progress import ProgressLine
from negopipe.stages.setup import device_of

if TYPE_CHECKING:
    from negopipe.config import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

CONVERGED = 0.05
"""A search is said to have converged if twice the budget gains less than this, in mean return."""


def run(config: "RunConfig", run: "TrackedRun") -> None:
    """Search all settings; writes oracle.csv and the part `oracle` of metrics.json."""
    game = build_game(config, device_of(config), is_compiled=config.compile == "on")
    rows, measures = [], {}
    n_rounds = 2 * config.oracle.rounds
    with ProgressLine("oracle", len(config.oracle.settings) * n_rounds) as progress:
        for setting in config.oracle.settings:
            tasks = oracle_tasks(config, game, setting)
            half, best = find(config, game, tasks, setting, progress)
            trace = play(config, game, tasks, best, setting)
            fixed = drive_fixed(config, game, tasks, setting)
            rows.append(table(config, trace, fixed))
            measures[setting] = _measures(config, trace, fixed, half, best)
            _say(setting, measures[setting])
    pd.concat(rows, ignore_index=True).to_csv(run.folder / "oracle.csv", index=False)
    run.log_artifact(run.folder / "oracle.csv")
    run.update_metrics_json({"oracle": measures})


def oracle_tasks(config: "RunConfig", game: Game, setting: str) -> Task:
    """The first of the evaluation's tasks, so that returns can be compared task by task."""
    n = config.oracle.n_episodes
    return map_tensors(lambda field: field[:n], held_out_tasks(config, game, setting))


def find(
    config: "RunConfig", game: Game, tasks: Task, setting: str, progress: ProgressLine
) -> tuple[Sequences, Sequences]:
    """What is found [N] with the configured budget, and with twice that."""
    rollouts = Rollouts(game, config.policy.horizons_s, config.evaluation.reward)
    random = generator(config.seed, f"oracle {setting}", tasks.family.device)
    best = half = best_simple(rollouts, tasks)
    for index in range(2 * config.oracle.rounds):
        best = improve(rollouts, tasks, best, config.oracle.population, random)
        half = best if index + 1 == config.oracle.rounds else half
        progress.advance(f"{setting}, return {best.reward.mean():.2f}")
    return half, best


def play(config: "RunConfig", game: Game, tasks: Task, best: Sequences, setting: str) -> Trace:
    """The record of the sequences `best` [N], driven like every planner."""
    horizons = torch.tensor(config.policy.horizons_s, device=best.actions.device)
    return _drive(config, game, sequence_planner(horizons[best.actions.T]), tasks, (ORACLE, setting))


def drive_fixed(config: "RunConfig", game: Game, tasks: Task, setting: str) -> dict[float, Trace]:
    """The record of each fixed horizon among the ego's choices."""
    horizons_s = list(config.policy.horizons_s)
    planners = fixed_planners(horizons_s)
    return {h: _drive(config, game, planners[fixed_name(h)], tasks, (fixed_name(h), setting)) for h in horizons_s}


def _drive(config: "RunConfig", game: Game, choose: ChooseHorizon, tasks: Task, names: tuple[str, str]) -> Trace:
    return drive_episodes(game, choose, tasks, len(tasks), config.evaluation.reward, names)


def table(config: "RunConfig", trace: Trace, fixed: dict[float, Trace]) -> pd.DataFrame:
    """One row per task of a setting, `episode` as in the evaluation's episodes.csv.

    Columns of `metrics.episodes` (reward is the oracle's return), and
    n_switches: changes of the horizon, those without effect too
    best_fixed_horizon_s, best_fixed_reward: the fixed horizon with the highest return on the task, the shortest
        of equally good ones
    fixed_<h>_outcome, fixed_<h>_reward: of each fixed horizon on the task
    """
    rows = episodes(trace, config.scenario.road.corridor_length_m)
    others = {h: episodes(each, config.scenario.road.corridor_length_m) for h, each in fixed.items()}
    returns = np.stack([each["reward"] for each in others.values()])
    beside = {
        f"{fixed_name(h)}_{column}": each[column].to_numpy()
        for h, each in others.items()
        for column in ("outcome", "reward")
    }
    columns = "setting episode ego_start_distance_m social_start_distance_m style_horizon_s outcome reward "
    columns += "ego_time_s social_time_s"
    return rows[columns.split()].assign(
        n_switches=n_switches(trace),
        best_fixed_horizon_s=np.array(list(fixed))[returns.argmax(0)],
        best_fixed_reward=returns.max(0),
        **beside,
    )


def n_switches(trace: Trace) -> np.ndarray:
    """[E] int64: how often the ego's horizon changed before the episode ended."""
    horizon = trace.horizon_s[:, :, EGO]
    return ((horizon[1:] != horizon[:-1]) & running(trace)[1:]).sum(0)


def _measures(
    config: "RunConfig", trace: Trace, fixed: dict[float, Trace], half: Sequences, best: Sequences
) -> dict[str, Any]:
    """`oracle.<setting>` of metrics.json; the fixed horizons beside it."""
    length_m = config.scenario.road.corridor_length_m
    found = pd.concat([episodes(each, length_m) for each in (trace, *fixed.values())])
    by_planner = summary(found)["evaluation"][trace.family]
    own = by_planner.pop(ORACLE)
    gain = float((best.reward - half.reward).mean())
    return {
        "n_tasks": own["n_episodes"],
        **{name: own[name] for name in ("success_rate", "collision_rate", "driving_time_s", "reward")},
        "reward_at_half_budget": float(half.reward.mean()),
        "gain_by_doubling": gain,
        "is_converged": gain < CONVERGED,
        "fixed": {name: {k: m[k] for k in ("reward", "success_rate")} for name, m in by_planner.items()},
    }


def _say(setting: str, m: dict[str, Any]) -> None:
    fixed = ", ".join(f"{name} {each['reward']:.2f}" for name, each in m["fixed"].items())
    log.info(
        f"{setting:10} oracle {m['reward']:.2f} ({m['success_rate']:.1%} success), {fixed}; doubling the search "
        f"gained {m['gain_by_doubling']:.3f}: {'converged' if m['is_converged'] else 'not converged'}"
    )
