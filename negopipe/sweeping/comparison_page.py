"""The page over many runs: which config does better over its seeds, and with what certainty."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from negopipe.evaluation.statistics import probability_of_improvement
from negopipe.evaluation.trace import ADAPTIVE
from negopipe.report.captions import caption
from negopipe.report.figures import render
from negopipe.report.labels import setting_label
from negopipe.report.page import Chapter, FigureItem, Provenance, Section, build_page
from negopipe.report.provenance import claims_text, versions
from negopipe.report.tables import Cell, Column, Row, Table, table
from negopipe.sweeping.curriculum_claim import curriculum_claim
from negopipe.sweeping.groups import Groups, LeftOut, short_names
from negopipe.sweeping.learning_curves import COLORS, learning_curves, read_curves
from negopipe.sweeping.seeds import across_seeds, by_seed
from negopipe.sweeping.swept_runs import SweptRun, differing_keys
from negopipe.tracking.run_folder import CONFIG_NAME
from negopipe.tracking.whole_file import write_whole

EVEN = 0.5
"""Share of pairs in which either of two groups has more reward, if they are alike."""
RANDOM_SEED = 0
"""Seed of the bootstrap: the same runs give the same intervals."""
SAME_M = 1e-6
"""Start distances that differ by no more are of the same task."""

SUCCESS = Column("success [%]", "success_rate", 100, 1, "max", ("success_rate_low", "success_rate_high"))
COLLISION = Column("collision [%]", "collision_rate", 100, 2, "min", ("collision_rate_low", "collision_rate_high"))
REWARD = Column("reward (Eq. 3)", "reward", 1, 2, "max", ("reward_low", "reward_high"))
BETTER = Column("more reward than the first [%]", "better", 100, 0, None, ("better_low", "better_high"))
SEEDS = Column("seeds", "n_seeds", 1, 0)
EPISODES = Column("episodes", "n_episodes", 1, 0)


def write_page(
    target: Path, title: str, runs: Sequence[SweptRun], groups: Groups, episodes: pd.DataFrame, command: str
) -> None:
    """Write report.html, and claims.json where the runs tell of the paper's claim on the curriculum.

    episodes: rows of `seeds.read_episodes`
    command: that asked for the page, as it is shown on it
    LeftOut where one run only is evaluated, or where the groups drove different tasks.
    """
    own = comparable(episodes)
    claim = curriculum_claim(groups, episodes)
    claims = [] if claim is None else [claim]
    short = short_names(own["group"].unique())
    verdicts, chapters = compare(own.assign(group=own["group"].map(short)))
    curves = read_curves(runs, groups)
    curves = curves[curves["group"].isin(short)]
    sections = [_training(curves.assign(group=curves["group"].map(short)))]
    page = build_page(title, verdicts, [*_configs(short), *chapters], claims, sections, provenance(runs, command))
    write_whole(target / "report.html", page.encode())
    print(f"page       {target / 'report.html'}")
    for head, _ in verdicts:
        print(f"           {head}")
    for name, letter in short.items():
        if name != letter and any(f": {letter} has " in head for head, _ in verdicts):
            print(f"           {letter} is {name}")
    if claims:
        write_whole(target / "claims.json", claims_text(claims).encode())
        print(f"claims     {target / 'claims.json'}: claim {claims[0].number} (curriculum), {claims[0].verdict}")


def comparable(episodes: pd.DataFrame) -> pd.DataFrame:
    """The policies' rows; LeftOut where they are of one run only or of different tasks."""
    own = episodes[episodes["planner"] == ADAPTIVE]
    if len(own[["group", "seed"]].drop_duplicates()) < 2:
        raise LeftOut("one run only is evaluated; its own report.html shows it")
    distances = own.groupby(["setting", "episode"])["social_start_distance_m"].agg(["min", "max"])
    differing = distances.index[distances["max"] - distances["min"] > SAME_M]
    if len(differing):
        setting, episode = differing[0]
        raise LeftOut(f"the runs must have driven the same tasks, got others in {setting}, episode {episode}")
    return own


def _configs(short: Mapping[str, str]) -> list[Chapter]:
    """The configs' names, where letters stand for them."""
    if list(short) == list(short.values()):
        return []
    colors = _colors(short)
    rows = [Row(letter, colors[name], [Cell(name)]) for name, letter in short.items()]
    names = Table("Letters of the configs", ["overrides that set it apart"], rows)
    return [Chapter("Configs", f"{len(rows)} configs, named by letters", [names])]


def _colors(names: Collection[str]) -> dict[str, str]:
    return dict(zip(names, len(names) * COLORS, strict=False))


def _training(curves: pd.DataFrame) -> Section:
    if curves.empty:
        return Section("Training", "None of the runs was trained.", [])
    return Section("Training", "", [FigureItem(*caption("learning_curves"), render(learning_curves(curves), "svg"))])


def provenance(runs: Sequence[SweptRun], command: str) -> Provenance:
    """The command, the seeds of all runs, and the first run's config with a note on the keys in which others differ."""
    first = runs[0]
    seeds = sorted({run.config["seed"] for run in runs})
    text = (first.folder / CONFIG_NAME).read_text(encoding="utf-8")
    differing = [*(["seed"] if len(seeds) > 1 else []), *differing_keys(runs)]
    note = f"# {first.name}; the other runs differ from it in {', '.join(differing)}\n" if differing else ""
    return Provenance(command, ", ".join(map(str, seeds)), note + text, versions())


def compare(episodes: pd.DataFrame) -> tuple[list[tuple[str, str]], list[Chapter]]:
    """Verdicts and tables per setting: interquartile means over seeds, how likely a group beats the first, each seed.

    episodes: the policies' rows, as `comparable` gives them
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
    nearest = min(ahead, key=lambda name: (ahead[name].value, -rewards[name].mean()))
    close = [name for name, share in ahead.items() if not share.low > EVEN]
    doubt = f", but not clearly higher than {close[0] if len(close) == 1 else f'{len(close)} others'}" if close else ""
    head = f"{setting_label(setting)}: {best} has the highest reward of {len(rewards)} configs{doubt}."
    share = ahead[nearest]
    interval = "" if np.isnan(share.low) else f" [{100 * share.low:.0f}, {100 * share.high:.0f}]"
    pairs = f"a seed of it has more reward than one of {nearest} in {100 * share.value:.0f} %{interval} of the pairs"
    return head, f"{detail} Of all others, {nearest} comes nearest: {pairs}."


def _chapter(setting: str, across: Mapping[str, Mapping[str, Any]], seeds: Mapping[str, pd.DataFrame]) -> Chapter:
    labels = {name: name for name in across}
    colors = _colors(across)
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
