"""Many runs compared: which config does better over its seeds, and how surely. Read from the run folders alone."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np
import pandas as pd

from negopipe.config.root import RESULT_NEUTRAL
from negopipe.errors import UserError
from negopipe.evaluation.claims import judge_curriculum
from negopipe.evaluation.hypothesis import Claim
from negopipe.evaluation.statistics import probability_of_improvement
from negopipe.evaluation.trace import ADAPTIVE
from negopipe.report.labels import setting_label
from negopipe.report.page import Chapter
from negopipe.report.tables import Column, table
from negopipe.sweeping.learning_curves import COLORS, MEASURES
from negopipe.sweeping.seeds import across_seeds, by_seed, read_tables
from negopipe.sweeping.swept_runs import SweptRun, differing_keys, read_runs
from negopipe.tracking.csv_file import read_csv
from negopipe.tracking.run_folder import CONFIG_NAME, HISTORY_NAME
from negopipe.tracking.training_files import HISTORY

NOT_COMPARED = ("evaluation.baselines", "evaluation/baseline", "evaluation.oracle")
"""Beginnings of keys and overrides that change nothing about a policy."""
LONGEST_NAME = 28
EVEN = 0.5
"""Share of pairs in which either of two groups has more reward, if they are alike."""
RANDOM_SEED = 0
"""Of the bootstrap: the same runs give the same intervals."""

SUCCESS = Column("success [%]", "success_rate", 100, 1, "max", ("success_rate_low", "success_rate_high"))
COLLISION = Column("collision [%]", "collision_rate", 100, 2, "min", ("collision_rate_low", "collision_rate_high"))
REWARD = Column("reward (Eq. 3)", "reward", 1, 2, "max", ("reward_low", "reward_high"))
BETTER = Column("more reward than the first [%]", "better", 100, 0, None, ("better_low", "better_high"))
SEEDS = Column("seeds", "n_seeds", 1, 0)
EPISODES = Column("episodes", "n_episodes", 1, 0)

Groups = Mapping[str, Sequence[Path]]
"""Runs of one config with several seeds, by what sets the config apart."""


def find_runs(outputs: Path, pattern: str) -> dict[Path, SweptRun]:
    """The evaluated runs whose `<name>` or tag `sweep` matches; UserError, which tells the names, if there is none."""
    names = sorted({path.parent.parent.name for path in outputs.glob(f"*/*/{CONFIG_NAME}")})
    runs = {outputs / name / run.name: run for name in names for run in read_runs(outputs / name)}
    found = {
        folder: run
        for folder, run in runs.items()
        if (fnmatch(folder.parent.name, pattern) or fnmatch(run.sweep or "", pattern)) and "evaluate" in run.finished
    }
    if not found:
        known = ", ".join(names) or "none"
        raise UserError(f"runs must match the name or sweep of runs that are evaluated, among {known}, got {pattern}")
    return found


def group(runs: Mapping[Path, SweptRun]) -> dict[str, list[Path]]:
    """Runs of one config together, named by the overrides that set it apart."""
    keys = _compared_keys(runs)
    shared = set.intersection(*(set(run.overrides) for run in runs.values()))
    names: dict[str, str] = {}
    groups: dict[str, list[Path]] = {}
    for folder, run in runs.items():
        own = [text for text in run.overrides if text not in shared and _is_compared(text)]
        config = str([run.config.get(key) for key in keys])
        if config not in names:
            name = " ".join(own) or "all runs"
            names[config] = name if name not in names.values() else f"{name} ({len(names) + 1})"
        groups.setdefault(names[config], []).append(folder)
    return groups


def _compared_keys(runs: Mapping[Path, SweptRun]) -> list[str]:
    return [key for key in differing_keys(list(runs.values())) if not key.startswith(NOT_COMPARED)]


def _is_compared(override: str) -> bool:
    key = override.lstrip("+~").partition("=")[0]
    return not override.startswith(NOT_COMPARED) and key not in RESULT_NEUTRAL


def short_names(names: Iterable[str]) -> dict[str, str]:
    """The names themselves where they fit a table, else letters."""
    names = list(names)
    if all(len(name) <= LONGEST_NAME for name in names):
        return {name: name for name in names}
    return {name: ascii_uppercase[i % 26] * (1 + i // 26) for i, name in enumerate(names)}


def read_groups(groups: Groups) -> pd.DataFrame:
    """The policies' rows of episodes.csv with columns `seed` and `group`.

    Raises UserError if a seed comes twice in a group, or if the policies drove different tasks.
    """
    tables = [read_tables(folders).assign(group=name) for name, folders in groups.items()]
    episodes = pd.concat(tables, ignore_index=True)
    own = episodes[episodes["planner"] == ADAPTIVE]
    for (setting, episode), distances in own.groupby(["setting", "episode"])["social_start_distance_m"]:
        if np.ptp(distances) > 0:
            raise UserError(f"runs must have driven the same tasks, got others in {setting}, episode {episode}")
    return own


def read_histories(groups: Groups) -> pd.DataFrame:
    """What `learning_curves` draws of the runs that were trained; empty if none was."""
    columns = ["decisions", "wall_s", *MEASURES]
    tables = [
        read_csv(folder / HISTORY_NAME, HISTORY, columns)[columns].assign(group=name, seed=seed)
        for name, folders in groups.items()
        for seed, folder in enumerate(folders)
        if (folder / HISTORY_NAME).exists()
    ]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=["group", "seed", *columns])


def compare(episodes: pd.DataFrame) -> tuple[list[tuple[str, str]], list[Chapter]]:
    """Verdicts and tables per setting: interquartile means over seeds, how likely a group beats the first, each seed.

    episodes: rows of `read_groups`
    """
    verdicts, chapters = [], []
    for setting, rows in episodes.groupby("setting", sort=False):
        seeds = {str(name): by_seed(own, None) for name, own in rows.groupby("group", sort=False)}
        first = next(iter(seeds.values()))  # of those that drove this setting
        across = {name: _across(own, first) for name, own in seeds.items()}
        best = max(across, key=lambda name, across=across: across[name]["reward"])  # type: ignore[misc]
        rewards = {name: own["reward"].to_numpy() for name, own in seeds.items()}
        verdicts.append(_verdict(str(setting), best, across[best], rewards))
        chapters.append(_chapter(str(setting), across, seeds))
    return verdicts, chapters


def curriculum_claim(runs: Mapping[Path, SweptRun]) -> Claim | None:
    """The paper's claim on the curriculum; None where the runs differ in more than it, or none of them does without."""
    is_only_curriculum = all(key.startswith("curriculum.") for key in _compared_keys(runs))
    n_iterations = {sum(_of_stages(run, "n_iterations")) for run in runs.values()}
    rewards: dict[bool, list[float]] = {True: [], False: []}
    for folder, run in runs.items():
        rewards[len(_of_stages(run, "name")) > 1].append(_mean_reward(folder))
    if not (is_only_curriculum and len(n_iterations) == 1 and all(rewards.values())):
        return None
    return judge_curriculum(np.array(rewards[True]), np.array(rewards[False]))


def _of_stages(run: SweptRun, key: str) -> list[Any]:
    return [value for name, value in run.config.items() if fnmatch(name, f"curriculum.stages.*.{key}")]


def _mean_reward(folder: Path) -> float:
    """The policy's, mean over the settings."""
    episodes = read_tables([folder])
    own = episodes[episodes["planner"] == ADAPTIVE]
    return float(own.groupby("setting")["reward"].mean().mean())


def _across(seeds: pd.DataFrame, first: pd.DataFrame) -> dict[str, Any]:
    """One group: `across_seeds` and how likely one of its runs has more reward than one of the first group."""
    (row,) = across_seeds(seeds).to_dict("records")
    rng = np.random.default_rng(RANDOM_SEED)
    better = probability_of_improvement(seeds["reward"].to_numpy(), first["reward"].to_numpy(), rng)
    return _known({**row, "better": better.value, "better_low": better.low, "better_high": better.high})


def _known(row: Mapping[Any, Any]) -> dict[str, Any]:
    """None for what there is no figure of."""
    return {str(name): None if isinstance(value, float) and np.isnan(value) else value for name, value in row.items()}


def _verdict(setting: str, best: str, found: Mapping[str, Any], rewards: Mapping[str, np.ndarray]) -> tuple[str, str]:
    """rewards: of each group, one per seed"""
    over = f"{found['n_seeds']} seed{'s' if found['n_seeds'] > 1 else ''}"
    figures = f"reward {found['reward']:.2f}, success {100 * found['success_rate']:.1f} %, over {over}"
    detail = f"Interquartile means over seeds: {figures}."
    if len(rewards) == 1:
        return f"{setting_label(setting)}: {best}, {over}.", detail
    rng = np.random.default_rng(RANDOM_SEED)
    ahead = {name: probability_of_improvement(rewards[best], own, rng) for name, own in rewards.items() if name != best}
    nearest = min(ahead, key=lambda name: ahead[name].value)
    close = [name for name, share in ahead.items() if not share.low > EVEN]
    doubt = f", but not clearly higher than {close[0] if len(close) == 1 else f'{len(close)} others'}" if close else ""
    head = f"{setting_label(setting)}: {best} has the highest reward of {len(rewards)} configs{doubt}."
    share = ahead[nearest]
    interval = "" if np.isnan(share.low) else f" [{100 * share.low:.0f}, {100 * share.high:.0f}]"
    pairs = f"a seed of it has more reward than one of {nearest} in {100 * share.value:.0f} %{interval} of the pairs"
    return head, f"{detail} Of all others, {nearest} comes nearest: {pairs}."


def _chapter(setting: str, across: Mapping[str, Mapping[str, Any]], seeds: Mapping[str, pd.DataFrame]) -> Chapter:
    labels = {name: name for name in across}
    colors = dict(zip(across, len(across) * COLORS, strict=False))
    columns = [SUCCESS, COLLISION, REWARD, *([BETTER] if len(across) > 1 else []), SEEDS]
    tables = [table("Over seeds: interquartile means and their intervals", columns, across, labels, colors)]
    each = {
        f"{name}, seed {row['seed']}": (name, _known(row))
        for name, own in seeds.items()
        for row in own.to_dict("records")
    }
    tables.append(
        table(
            "Every seed",
            [SUCCESS, COLLISION, replace(REWARD, bounds=None), EPISODES],
            {label: row for label, (_, row) in each.items()},
            {label: label for label in each},
            {label: colors[name] for label, (name, _) in each.items()},
        )
    )
    counts = {int(n) for own in seeds.values() for n in own["n_episodes"]}
    n_episodes = " to ".join(str(n) for n in sorted({min(counts), max(counts)}))
    return Chapter(setting_label(setting), f"{n_episodes} episodes per seed, the same tasks for all", tables)
