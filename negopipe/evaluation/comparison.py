"""Paired differences on the same tasks, to the policy and to the oracle, with intervals, for metrics.json."""

from typing import Any

import numpy as np
import pandas as pd

from negopipe.evaluation import measures
from negopipe.evaluation.statistics import mean_difference
from negopipe.evaluation.trace import ADAPTIVE, ORACLE

RANDOM_SEED = 0
"""Seed of the bootstrap, so that the same episodes give the same intervals."""


def versus_adaptive(table: pd.DataFrame) -> dict[str, Any]:
    """`versus_adaptive.<setting>.<planner>.<stem>` as nested dicts, from rows of episodes.csv.

    An entry of a measure that is `compared` holds value, low and high: the planner's mean less the policy's over the
    n_tasks in which both have a value, with a bootstrap interval over tasks. value, low and high are None without such
    a task, low and high with a single one.
    """
    rng = np.random.default_rng(RANDOM_SEED)
    differences: dict[str, Any] = {}
    for setting, rows in table.groupby("setting", sort=False):
        by_planner = {str(name): _compared(own) for name, own in rows.groupby("planner", sort=False)}
        ours = by_planner.pop(ADAPTIVE)
        differences[str(setting)] = {
            name: {stem: _difference(values, ours[stem], rng) for stem, values in theirs.items()}
            for name, theirs in by_planner.items()
        }
    return {"versus_adaptive": differences}


def _compared(rows: pd.DataFrame) -> dict[str, pd.Series]:
    """Values by episode of the measures that are compared."""
    by_episode = rows.set_index("episode")
    return {m.stem: m.compared(by_episode[m.column]) for m in measures.MEASURES if m.compared is not None}


def regret(table: pd.DataFrame) -> dict[str, Any]:
    """`regret.<setting>.<planner>` as nested dicts: the oracle's mean reward less the planner's over the n_tasks that
    both drove, as value, low and high. Empty for a setting without an oracle.
    """
    rng = np.random.default_rng(RANDOM_SEED)
    by_setting: dict[str, Any] = {}
    for setting, rows in table.groupby("setting", sort=False):
        rewards = {str(name): own.set_index("episode")["reward"] for name, own in rows.groupby("planner", sort=False)}
        best = rewards.pop(ORACLE, None)
        found = {} if best is None else {name: _difference(best, own, rng) for name, own in rewards.items()}
        by_setting[str(setting)] = found
    return {"regret": by_setting}


def _difference(theirs: pd.Series, ours: pd.Series, rng: np.random.Generator) -> dict[str, float | int | None]:
    """Mean of theirs less ours over the episodes in which both have a value."""
    both = pd.concat([theirs, ours], axis=1, join="inner").dropna().to_numpy()
    if len(both) == 0:
        return {"value": None, "low": None, "high": None, "n_tasks": 0}
    found = mean_difference(both[:, 0], both[:, 1], rng)
    bounds = {name: None if np.isnan(bound) else bound for name, bound in (("low", found.low), ("high", found.high))}
    return {"value": found.value, **bounds, "n_tasks": len(both)}
