"""The replay stage: one evaluated episode, or a person's encounter, reproduced bit for bit, as an animation."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
from omegaconf import OmegaConf

from negopipe.config.root import load
from negopipe.errors import UserError
from negopipe.evaluation.encounter import difference, drive_again, read_encounter
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.horizon_text import from_text
from negopipe.evaluation.recorded_drive import commonroad_scenario
from negopipe.evaluation.replay import PolicyTrace, record_policy, replay
from negopipe.evaluation.trace import ADAPTIVE, EPISODE_AXIS, TRACES_NAME, Trace, load_traces
from negopipe.game.game import Game, build_game
from negopipe.report import animation
from negopipe.report.scene import scene_of
from negopipe.runtime.build import build, load_weights, with_learned
from negopipe.simulation.state import Task
from negopipe.stages.evaluate import checkpoint_of, drive_baseline, measure
from negopipe.tensors.torch_settings import own_settings
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.csv_file import csv_text, parse_csv, read_csv
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.policy.actor_critic import ActorCritic
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

FOLDER = "replays"
KEYS = ("setting", "planner", "episode")
"""Columns of episodes.csv that identify an episode."""


class EpisodeId(NamedTuple):
    """Identity of an episode: the columns setting, planner and episode of episodes.csv."""

    setting: str
    planner: str
    episode: int


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Drive `episode` or `encounter` again; writes replays/<name>.gif, a still, .png, and the drive, .xml.

    The name is <setting>_<planner>_<number> of an episode and that of the file of an encounter. Raises UserError if the
    episode was not evaluated in this run, or if a replay differs from what was driven then.
    """
    if config.encounter is not None:
        path = Path(config.encounter)
        own, game, trace = _encounter_again(config, path)
        _show(own, game, path.stem, trace, None, tracked)
        return
    which, row = find_episode(config, tracked.folder)
    game, policy = build(config)
    load_weights(checkpoint_of(config, tracked), policy, config)
    only = slice(which.episode, which.episode + 1)
    tasks = map_tensors(lambda field: field[only], held_out_tasks(config, game, which.setting))
    trace = _drive(config, game, tasks, which, row)
    _check_same(config, tracked.folder, which, row, trace)
    policy_trace = _policy_trace(config, game, policy, tasks, row) if which.planner == ADAPTIVE else None
    _show(config, game, "_".join(map(str, which)), trace, policy_trace, tracked)


def _show(
    config: "RunConfig",
    game: Game,
    name: str,
    trace: Trace,
    policy_trace: PolicyTrace | None,
    tracked: "TrackedRun",
) -> None:
    """Write the files of a drive into the run folder."""
    folder = tracked.folder / FOLDER
    folder.mkdir(exist_ok=True)
    scene = scene_of(game.simulator.road, int(trace.street[0]), config.planner.horizon_s)
    fixed_s = config.evaluation.fixed_horizons_s
    files = {
        "gif": animation.animate([trace], 0, scene, config.report.animation_fps, fixed_s, policy_trace),
        "png": animation.still([trace], 0, scene, trace.n_steps[0] * trace.dt_s / 3, fixed_s, policy_trace),
        "xml": commonroad_scenario(config.scenario, game.simulator.road, trace, 0),
    }
    for suffix, data in files.items():
        path = folder / f"{name}.{suffix}"
        write_whole(path, data)
        tracked.log_artifact(path, FOLDER)
        log.info("replay     %s", path)


@own_settings()
def _encounter_again(config: "RunConfig", path: Path) -> "tuple[RunConfig, Game, Trace]":
    """The encounter of a file, driven again under its own config; UserError where a bit of the drive is another."""
    encounter = read_encounter(path)
    own = replace(load(OmegaConf.create(dict(encounter.config))), report=config.report)
    game = with_learned(build_game(own), own, None)
    trace = drive_again(own, game, encounter)
    if name := difference(encounter.drive, trace):
        made_by = ", ".join(f"{key} {value}" for key, value in encounter.made_by.items())
        raise UserError(f"encounter {path} must be as driven, got another {name} (made by {made_by})")
    log.info(f"replay     {path.name}: as driven, to the last bit")
    return own, game, trace


def find_episode(config: "RunConfig", folder: Path) -> tuple[EpisodeId, pd.Series]:
    """The episode that the config names and its row of episodes.csv."""
    path = folder / EPISODES_NAME
    table = read_csv(path, EPISODES.texts, KEYS)
    if "horizons" not in table:
        raise UserError(
            f"{path}: has no column horizons, since older code wrote it; run the stage `evaluate` anew (rerun=true)"
        )
    setting, planner, number = str(config.episode).split("/")
    own = table[(table["setting"] == setting) & (table["planner"] == planner)]
    row = own[own["episode"] == str(int(number))]
    if row.empty:
        settings, planners = (", ".join(table[name].unique()) for name in ("setting", "planner"))
        n_driven = len(own) or table["episode"].astype(int).max() + 1
        raise UserError(
            f"episode must be <setting>/<planner>/<number> with a setting of {settings}, a planner of {planners} and "
            f"a number below {n_driven}, got {config.episode}"
        )
    return EpisodeId(setting, planner, int(number)), row.iloc[0]


def _drive(config: "RunConfig", game: Game, tasks: Task, which: EpisodeId, row: pd.Series) -> Trace:
    """The record of the stored horizons; a driver without horizons drives again."""
    names = (which.planner, which.setting)
    if row["horizons"]:
        return replay(game, tasks, [from_text(row["horizons"])], config.evaluation.reward, names)
    return drive_baseline(config, game, config.evaluation.baselines[which.planner], tasks, names)


def _check_same(config: "RunConfig", folder: Path, which: EpisodeId, row: pd.Series, trace: Trace) -> None:
    """Check every value of its row and, if its record was kept, every state to the last bit.

    Without a compiler the last bits depend on the other worlds of a batch; then outcome and duration are checked.
    """
    is_exact = config.compile == "on"
    driven = parse_csv(csv_text(measure(config, trace), EPISODES), EPISODES.texts).iloc[0]
    compared = list(driven.index.drop("episode")) if is_exact else ["outcome", "n_decisions"]
    stored = read_csv(folder / EPISODES_NAME, EPISODES.texts, compared).iloc[int(str(row.name))]
    for name in compared:
        if driven[name] != stored[name]:
            said = f"{name} {driven[name]} for {stored[name]}"
            raise UserError(f"episode {config.episode} must be as evaluated, got {said}")
    kept = [t for t in load_traces(folder / TRACES_NAME) if (t.setting, t.planner) == (which.setting, which.planner)]
    is_kept = is_exact and bool(kept) and which.episode < len(kept[0].n_steps)
    if is_kept:
        _check_bits(config, which, kept[0], trace)
    log.info(f"replay     {config.episode}: as evaluated{', to the last bit' if is_kept else ''}")


def _check_bits(config: "RunConfig", which: EpisodeId, kept: Trace, trace: Trace) -> None:
    for name, axis in EPISODE_AXIS.items():
        then = np.take(getattr(kept, name), [which.episode], axis)
        if not np.array_equal(then, getattr(trace, name), equal_nan=then.dtype.kind == "f"):
            raise UserError(f"episode {config.episode} must be as evaluated, got another {name}")


def _policy_trace(config: "RunConfig", game: Game, policy: "ActorCritic", tasks: Task, row: pd.Series) -> PolicyTrace:
    horizons, interval_s = config.policy.horizons_s, config.observation.frame_interval_s
    chosen = [from_text(row["horizons"])]
    return record_policy(game, policy, horizons, interval_s, tasks, chosen, config.evaluation.reward)[0]
