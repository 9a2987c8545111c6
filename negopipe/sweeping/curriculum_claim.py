"""The paper's claim on the curriculum (claim 10), judged from runs with and without it."""

from fnmatch import fnmatch
from typing import Any

import numpy as np
import pandas as pd

from negopipe.evaluation.claims import judge_curriculum
from negopipe.evaluation.hypothesis import Claim
from negopipe.evaluation.trace import ADAPTIVE
from negopipe.sweeping.groups import Groups, compared_keys
from negopipe.sweeping.swept_runs import SweptRun


def curriculum_claim(groups: Groups, episodes: pd.DataFrame) -> Claim | None:
    """The claim; None where the evaluated runs differ in more than the curriculum, or where none does without.

    episodes: rows of `seeds.read_episodes`
    """
    seeds = set(zip(episodes["group"], episodes["seed"], strict=True))
    runs = {(name, run.config["seed"]): run for name, members in groups.items() for run in members}
    evaluated = {key: run for key, run in runs.items() if key in seeds}
    is_only_curriculum = all(key.startswith("curriculum.") for key in compared_keys(list(evaluated.values())))
    n_iterations = {sum(_of_stages(run, "n_iterations")) for run in evaluated.values()}
    rewards: dict[bool, list[float]] = {True: [], False: []}
    for key, reward in _mean_rewards(episodes).items():
        rewards[len(_of_stages(evaluated[key], "name")) > 1].append(reward)
    if not (is_only_curriculum and len(n_iterations) == 1 and all(rewards.values())):
        return None
    return judge_curriculum(np.array(rewards[True]), np.array(rewards[False]))


def _of_stages(run: SweptRun, key: str) -> list[Any]:
    return [value for name, value in run.config.items() if fnmatch(name, f"curriculum.stages.*.{key}")]


def _mean_rewards(episodes: pd.DataFrame) -> dict[tuple[str, int], float]:
    """The policy's reward of each run, mean over the settings, by group and seed."""
    own = episodes[episodes["planner"] == ADAPTIVE]
    by_setting = own.groupby(["group", "seed", "setting"], sort=False)["reward"].mean()
    means = by_setting.groupby(level=["group", "seed"], sort=False).mean()
    rows = means.reset_index().itertuples(index=False, name=None)
    return {(str(group), int(seed)): float(reward) for group, seed, reward in rows}
