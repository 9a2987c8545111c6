"""The planners set against the policy, and against the oracle, on the same tasks: differences with paired intervals,
for metrics.json.
"""

from typing import Any

import numpy as np
import pandas as pd

from negopipe.evaluation.statistics import mean_difference
from negopipe.evaluation.trace import ADAPTIVE, ORACLE

MEASURES = ("success", "driving_time_s", "reward")
"""What is compared; times only of the tasks in which both arrive."""
RANDOM_SEED = 0
"""Of the bootstrap: the same episodes give the same intervals."""


def versus_adaptive(table: pd.DataFrame) -> dict[str, Any]:
    """`versus_adaptive.<setting>.<planner>.<measure>` as nested dicts, from rows of `metrics.episodes`.

    A measure holds value, low and high: the planner's mean less the policy's over the n_tasks that both have, with
    a bootstrap interval over tasks. All but n_tasks are None where there is too little to tell.
    """
    rng = np.random.default_rng(RANDOM_SEED)
    scored = table.assign(success=(table["outcome"] == "success").astype(float))
    compared: dict[str, Any] = {}
    for setting, rows in scored.groupby("setting", sort=False):
        by_planner = {str(name): own.set_index("episode") for name, own in rows.groupby("planner", sort=False)}
        ours = by_planner.pop(ADAPTIVE)
        compared[str(setting)] = {
            name: {measure: _difference(theirs[measure], ours[measure], rng) for measure in MEASURES}
            for name, theirs in by_planner.items()
        }
    return {"versus_adaptive": compared}


def regret(table: pd.DataFrame) -> dict[str, Any]:
    """`regret.<setting>.<planner>` as nested dicts: value, low and high of what the planner's mean reward lacks to the
    oracle's over the n_tasks that both drove. Empty for a setting in which no oracle drove.
    """
    rng = np.random.default_rng(RANDOM_SEED)
    lacking: dict[str, Any] = {}
    for setting, rows in table.groupby("setting", sort=False):
        rewards = {str(name): own.set_index("episode")["reward"] for name, own in rows.groupby("planner", sort=False)}
        best = rewards.pop(ORACLE, None)
        found = {} if best is None else {name: _difference(best, own, rng) for name, own in rewards.items()}
        lacking[str(setting)] = found
    return {"regret": lacking}


def _difference(theirs: pd.Series, ours: pd.Series, rng: np.random.Generator) -> dict[str, float | int | None]:
    both = pd.concat([theirs, ours], axis=1, join="inner").dropna().to_numpy()
    if len(both) == 0:
        return {"value": None, "low": None, "high": None, "n_tasks": 0}
    found = mean_difference(both[:, 0], both[:, 1], rng)
    bounds = {name: None if np.isnan(bound) else bound for name, bound in (("low", found.low), ("high", found.high))}
    return {"value": found.value, **bounds, "n_tasks": len(both)}
