"""The oracle stage: the best sequence of horizons per held-out task, and the fixed horizons on the same tasks."""

import logging
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch

from negopipe.agents.driver import ChooseHorizon, fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon, sequence_planner
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.measures import summary
from negopipe.evaluation.metrics import running
from negopipe.evaluation.names import fixed_name
from negopipe.evaluation.trace import ORACLE, Trace
from negopipe.game.game import Game
from negopipe.runtime.build import game_of
from negopipe.runtime.progress import ProgressLine
from negopipe.search.oracle import Rollouts, Sequences, best_simple, improve
from negopipe.search.oracle_table import ORACLE_TABLE
from negopipe.simulation.state import EGO, Task
from negopipe.tensors.seeding import generator
from negopipe.tensors.torch_settings import one_thread
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.csv_file import read_csv, write_csv

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

PARTS_NAME = "oracle"
"""Folder of a run with the finished settings."""
CONVERGED = 0.05
"""Gain in mean return by a doubled budget below which a search has converged."""


COLUMNS = (
    *("setting", "episode", "ego_start_distance_m", "social_start_distance_m", "style_horizon_s"),
    *("outcome", "reward", "ego_time_s", "social_time_s", "horizons"),
)
"""Columns of episodes.csv that oracle.csv repeats."""
MEASURED = ("planner", "driving_time_s", *COLUMNS)
"""Columns of episodes.csv that the stage computes."""


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Search all settings; writes oracle.csv (`table` and `n_switches`) and the part `oracle` of metrics.json.

    A stopped run resumes with the first unfinished setting.
    """
    game = game_of(config)
    parts = {setting: tracked.folder / PARTS_NAME / f"{setting}.csv" for setting in config.oracle.settings}
    n_rounds = 2 * config.oracle.rounds
    n_before = sum(part.exists() for part in parts.values()) * n_rounds
    with ProgressLine("oracle", len(parts) * n_rounds, n_before) as progress:
        for setting, part in parts.items():
            if not part.exists():
                _search(config, game, tracked, setting, part, progress)
    table = pd.concat([read_csv(part, ORACLE_TABLE.texts) for part in parts.values()])
    write_csv(tracked.folder / "oracle.csv", table, ORACLE_TABLE)
    tracked.log_artifact(tracked.folder / "oracle.csv")
    shutil.rmtree(tracked.folder / PARTS_NAME)


@one_thread()
def _search(
    config: "RunConfig", game: Game, run: "TrackedRun", setting: str, part: Path, progress: ProgressLine
) -> None:
    """Search one setting and write its rows to the file `part`, which marks the setting as finished."""
    tasks = oracle_tasks(config, game, setting)
    half, best = find(config, game, tasks, setting, progress)
    trace = play(config, game, tasks, best, setting)
    own = episodes(Drives.of(config, trace), MEASURED)
    fixed = fixed_episodes(config, game, tasks, setting)
    measures = _measures(own, fixed, half, best)
    _log_measures(setting, measures)
    run.update_metrics_json({"oracle": {setting: measures}})
    write_csv(part, table(own, fixed).assign(n_switches=n_switches(trace)), ORACLE_TABLE)


def oracle_tasks(config: "RunConfig", game: Game, setting: str) -> Task:
    """The first of the evaluation's tasks, so that returns can be compared task by task."""
    n = config.oracle.n_episodes
    return map_tensors(lambda field: field[:n], held_out_tasks(config, game, setting))


def find(
    config: "RunConfig", game: Game, tasks: Task, setting: str, progress: ProgressLine
) -> tuple[Sequences, Sequences]:
    """Sequences [N] found with the configured budget and with twice that."""
    rollouts = Rollouts(game, config.policy.horizons_s, config.evaluation.reward)
    random = generator(config.seed, f"oracle {setting}", tasks.family.device)
    best = half = best_simple(rollouts, tasks)
    for index in range(2 * config.oracle.rounds):
        best = improve(rollouts, tasks, best, config.oracle.population, random)
        half = best if index + 1 == config.oracle.rounds else half
        progress.advance(f"{setting}, return {best.reward.mean():.2f}")
    return half, best


def play(config: "RunConfig", game: Game, tasks: Task, best: Sequences, setting: str) -> Trace:
    """The record of the sequences `best` [N], driven like any planner."""
    horizons = torch.tensor(config.policy.horizons_s, device=best.actions.device)
    choose, paid = sequence_planner(horizons[best.actions.T]), config.evaluation.reward
    return drive_episodes(game, by_horizon(game, choose), tasks, len(tasks), paid, (ORACLE, setting), is_lockstep=True)


def fixed_episodes(config: "RunConfig", game: Game, tasks: Task, setting: str) -> dict[float, pd.DataFrame]:
    """Rows of episodes.csv of each fixed horizon among the ego's choices."""
    traces = {
        h: _drive(config, game, fixed_horizon(h), tasks, (fixed_name(h), setting)) for h in config.policy.horizons_s
    }
    return {h: episodes(Drives.of(config, trace), MEASURED) for h, trace in traces.items()}


def _drive(config: "RunConfig", game: Game, choose: ChooseHorizon, tasks: Task, names: tuple[str, str]) -> Trace:
    return drive_episodes(game, by_horizon(game, choose), tasks, len(tasks), config.evaluation.reward, names)


def table(own: pd.DataFrame, fixed: dict[float, pd.DataFrame]) -> pd.DataFrame:
    """One row per task of a setting, `episode` as in the evaluation's episodes.csv.

    COLUMNS: of the oracle's drive; reward is its return
    best_fixed_horizon_s, best_fixed_reward: the fixed horizon with the highest return on the task, the shortest
        of equally good ones
    fixed_<h>_outcome, fixed_<h>_reward: outcome and return of each fixed horizon on the task
    """
    returns = np.stack([each["reward"] for each in fixed.values()])
    beside = {
        f"{fixed_name(h)}_{column}": each[column].to_numpy()
        for h, each in fixed.items()
        for column in ("outcome", "reward")
    }
    return own[[*COLUMNS]].assign(
        best_fixed_horizon_s=np.array(list(fixed))[returns.argmax(0)],
        best_fixed_reward=returns.max(0),
        **beside,
    )


def n_switches(trace: Trace) -> np.ndarray:
    """[E] int64: number of changes of the ego's horizon before the episode ended."""
    horizon = trace.horizon_s[:, :, EGO]
    return ((horizon[1:] != horizon[:-1]) & running(trace)[1:]).sum(0)


def _measures(own: pd.DataFrame, fixed: dict[float, pd.DataFrame], half: Sequences, best: Sequences) -> dict[str, Any]:
    """`oracle.<setting>` of metrics.json, with the fixed horizons."""
    (by_planner,) = summary(pd.concat([own, *fixed.values()]))["evaluation"].values()
    found = by_planner.pop(ORACLE)
    gain = float((best.reward - half.reward).mean())
    return {
        "n_tasks": found["n_episodes"],
        **{name: found[name] for name in ("success_rate", "collision_rate", "driving_time_s", "reward")},
        "reward_at_half_budget": float(half.reward.mean()),
        "gain_by_doubling": gain,
        "is_converged": gain < CONVERGED,
        "fixed": {name: {k: m[k] for k in ("reward", "success_rate")} for name, m in by_planner.items()},
    }


def _log_measures(setting: str, m: dict[str, Any]) -> None:
    fixed = ", ".join(f"{name} {each['reward']:.2f}" for name, each in m["fixed"].items())
    log.info(
        f"{setting:10} oracle {m['reward']:.2f} ({m['success_rate']:.1%} success), {fixed}; gain by a doubled budget "
        f"{m['gain_by_doubling']:.3f}: {'converged' if m['is_converged'] else 'not converged'}"
    )
