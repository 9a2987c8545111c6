"""Training seeds together: rates, rewards and regret to the oracle, each with its interval.

Three tables are made of the runs' episodes.csv and, for the regret, of an oracle.csv:

seeds.csv   a row per seed, setting and planner: rates with Wilson intervals, reward, regret to the oracle
across.csv  a row per setting and planner: interquartile means across seeds, with bootstrap intervals
styles.csv  a row per setting, style of the other driver and planner, seeds pooled; the policy's success less the
            planner's on the same tasks, and the regret

Where several groups are compared, each has its own rows, and the first column names it.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from rich.markup import escape
from rich.table import Table

from negopipe.errors import UserError
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME
from negopipe.evaluation.statistics import Estimate, interquartile_mean, mean_difference, rate
from negopipe.evaluation.trace import ADAPTIVE
from negopipe.search.oracle_table import ORACLE_TABLE
from negopipe.sweeping.console import show
from negopipe.sweeping.groups import Groups, LeftOut
from negopipe.sweeping.swept_runs import SweptRun
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv

RATES = {"success": "success_rate", "collision": "collision_rate"}
"""Outcomes that are counted, and what their shares are called."""
NEEDED = (
    *("planner", "setting", "episode", "social_start_distance_m", "style_horizon_s"),
    *("outcome", "driving_time_s", "reward"),
)
"""Columns of episodes.csv that are read."""
GROUP = "group"
"""Column that names the group of a row."""
_WHO = {"setting": str, "planner": str}
_MADE_BY = "negopipe.sweeping.compare"
KINDS = {
    "seeds": CsvKind(_MADE_BY, {GROUP: str, "seed": int, **_WHO, "n_episodes": int, "*": float}),
    "across": CsvKind(_MADE_BY, {GROUP: str, **_WHO, "n_seeds": int, "*": float}),
    "styles": CsvKind(_MADE_BY, {GROUP: str, "style_s": str, **_WHO, "n_tasks": int, "*": float}),
}
"""The tables; a row of all styles has `all` for its style."""
RANDOM_SEED = 0
"""Seed of the bootstrap: the same runs give the same intervals."""
N_SHOWN = 40
"""Rows of the table that are shown; across.csv has all."""


def write_seeds(target: Path, episodes: pd.DataFrame, oracle: pd.DataFrame | None) -> None:
    """Write the three tables and print that over seeds, where a group has several.

    episodes: rows of `read_episodes`
    """
    groups = {str(name): own for name, own in episodes.groupby(GROUP, sort=False)}
    tables = seed_tables(groups, oracle)
    for name, table in tables.items():
        write_csv(target / f"{name}.csv", table, KINDS[name])
    if (tables["across"]["n_seeds"] > 1).any():
        _show(tables["across"])
    else:
        print("seeds      one per config: no table over seeds")
    print(f"seeds      {target / 'seeds.csv'}, across.csv, styles.csv")


def seed_tables(groups: Mapping[str, pd.DataFrame], oracle: pd.DataFrame | None) -> dict[str, pd.DataFrame]:
    """`by_seed`, `across_seeds` and `by_style` of each group, by the name of their file."""
    seeds = {name: by_seed(own, oracle) for name, own in groups.items()}
    across = {name: across_seeds(table) for name, table in seeds.items()}
    styles = {name: by_style(own, oracle) for name, own in groups.items()}
    return {"seeds": _stacked(seeds), "across": _stacked(across), "styles": _stacked(styles)}


def _stacked(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """The tables below each other, with a column that names the group where there are several."""
    if len(tables) == 1:
        return next(iter(tables.values()))
    return pd.concat([_named_first(table, name) for name, table in tables.items()], ignore_index=True)


def _named_first(table: pd.DataFrame, name: str) -> pd.DataFrame:
    return table.assign(**{GROUP: name})[[GROUP, *table.columns]]


def read_episodes(groups: Groups) -> pd.DataFrame:
    """Rows of `negopipe.evaluation.metrics.episodes` of all evaluated runs, with columns `group` and `seed`.

    The planners that are not trained drive alike in every run, so one run of a group that has them is enough.

    LeftOut if no run is evaluated, if two runs of a group have one seed or if their policies drove different tasks.
    """
    evaluated = {name: [run for run in runs if run.holds(EPISODES_NAME)] for name, runs in groups.items()}
    tables = [_read_group(name, runs) for name, runs in evaluated.items() if runs]
    if not tables:
        raise LeftOut("no run has been evaluated")
    return pd.concat(tables, ignore_index=True)


def _read_group(name: str, runs: Sequence[SweptRun]) -> pd.DataFrame:
    seeds = [int(run.config["seed"]) for run in runs]
    if len(set(seeds)) < len(seeds):
        got = ", ".join(map(str, seeds))
        raise LeftOut(f"a group must have one run per seed (--sweep picks some), got seeds {got} of {name}")
    tables = [read_csv(run.folder / EPISODES_NAME, EPISODES, NEEDED) for run in runs]
    tasks = [_tasks(table) for table in tables]
    for run, own in zip(runs[1:], tasks[1:], strict=True):
        if not own.equals(tasks[0]):
            raise LeftOut(f"{run.name} drove other tasks than {runs[0].name}; evaluate them alike")
    seeded = [table.assign(seed=seed) for seed, table in zip(seeds, tables, strict=True)]
    return pd.concat(seeded, ignore_index=True).assign(**{GROUP: name})


def _tasks(episodes: pd.DataFrame) -> pd.DataFrame:
    """The tasks that the policy of one run drove."""
    columns = ["setting", "episode", "social_start_distance_m", "style_horizon_s"]
    return episodes.loc[episodes["planner"] == ADAPTIVE, columns].reset_index(drop=True)


def by_seed(episodes: pd.DataFrame, oracle: pd.DataFrame | None) -> pd.DataFrame:
    """One row per seed, setting and planner.

    success_rate, collision_rate with _low and _high: Wilson intervals; driving_time_s: mean over arrivals
    reward: mean; regret with _low and _high: mean of the oracle's reward less the planner's, over the tasks that the
        oracle has, bootstrap interval over tasks; n_regret_tasks
    """
    rng = np.random.default_rng(RANDOM_SEED)
    rows = []
    for (seed, setting, planner), part in episodes.groupby(["seed", "setting", "planner"], sort=False):
        row = {"seed": seed, "setting": setting, "planner": planner, "n_episodes": len(part)}
        for outcome, name in RATES.items():
            row |= _named(name, rate((part["outcome"] == outcome).to_numpy()))
        row |= {"driving_time_s": part["driving_time_s"].mean(), "reward": part["reward"].mean()}
        if oracle is not None:
            row |= _regret(part, oracle[oracle["setting"] == setting], rng)
        rows.append(row)
    return pd.DataFrame(rows)


def across_seeds(seeds: pd.DataFrame) -> pd.DataFrame:
    """One row per setting and planner: the interquartile mean of each measure across seeds, and its interval.

    The interval resamples seeds; a planner that is not trained has the same figures for every seed, and a width of 0.
    """
    rng = np.random.default_rng(RANDOM_SEED)
    measures = [name for name in (*RATES.values(), "reward", "regret") if name in seeds]
    rows = []
    for (setting, planner), part in seeds.groupby(["setting", "planner"], sort=False):
        row = {"setting": setting, "planner": planner, "n_seeds": len(part)}
        for name in measures:
            if part[name].notna().all():
                row |= _named(name, interquartile_mean(part[name].to_numpy(), rng))
        rows.append(row)
    return pd.DataFrame(rows)


def by_style(episodes: pd.DataFrame, oracle: pd.DataFrame | None = None) -> pd.DataFrame:
    """One row per setting, style and planner, over all seeds, and one for all styles together.

    success_rate, collision_rate: shares. lead with _low and _high: the policy's success rate less the planner's, on
    the same tasks, paired bootstrap over tasks (a task's success is its share among the seeds). regret, as in
    `by_seed`, of a task's mean reward among the seeds
    """
    rng = np.random.default_rng(RANDOM_SEED)
    return pd.DataFrame(
        {"setting": setting, "style_s": style, **row}
        for setting, part in episodes.groupby("setting", sort=False)
        for style, tasks in [*part.groupby("style_horizon_s"), ("all", part)]
        for row in _styles_rows(tasks, None if oracle is None else oracle[oracle["setting"] == setting], rng)
    )


def _styles_rows(tasks: pd.DataFrame, oracle: pd.DataFrame | None, rng: np.random.Generator) -> Iterator[dict]:
    hits = {o: tasks.assign(hit=tasks["outcome"] == o).pivot_table("hit", "episode", "planner") for o in RATES}
    success = hits["success"]
    for planner in tasks["planner"].unique():
        row = {"planner": planner, "n_tasks": int(success[planner].count())}
        row |= {name: hits[outcome][planner].mean() for outcome, name in RATES.items()}
        if planner != ADAPTIVE and ADAPTIVE in success:
            both = success[[ADAPTIVE, planner]].dropna()  # some planners drive the first tasks only
            row |= _named("lead", mean_difference(both[ADAPTIVE].to_numpy(), both[planner].to_numpy(), rng))
        if oracle is not None:
            own = tasks[tasks["planner"] == planner].groupby("episode", as_index=False)
            row |= _regret(own[["reward", "social_start_distance_m"]].mean(), oracle, rng)
        yield row


def _regret(part: pd.DataFrame, oracle: pd.DataFrame, rng: np.random.Generator) -> dict:
    both = part.merge(oracle, on="episode", suffixes=("", "_oracle"))
    if both.empty:
        return {}
    is_same = np.isclose(both["social_start_distance_m"], both["social_start_distance_m_oracle"], atol=1e-3)
    if not is_same.all():
        setting = oracle["setting"].iloc[0]
        raise UserError(f"--oracle must be of the same tasks, got others in {setting} (evaluation.task_seed, scenario)")
    regret = mean_difference(both["reward_oracle"].to_numpy(), both["reward"].to_numpy(), rng)
    return {**_named("regret", regret), "n_regret_tasks": len(both)}


def read_oracle(path: Path) -> pd.DataFrame:
    """The rewards of an oracle.csv; UserError if it is none."""
    if not path.is_file():
        raise UserError(f"--oracle must be an oracle.csv, got {path}: no such file")
    return read_csv(path, ORACLE_TABLE, ("setting", "episode", "social_start_distance_m", "reward"))


def _named(name: str, estimate: Estimate) -> dict[str, float]:
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}


def _show(table: pd.DataFrame) -> None:
    """Groups of one setting and planner below each other; an estimate and its interval in one cell."""
    shown = [name for name in table if not str(name).endswith(("_low", "_high"))]
    view = Table(caption="Over seeds: interquartile means and their 95 % intervals")
    for name in shown:
        is_text = not pd.api.types.is_numeric_dtype(table[name])
        view.add_column(str(name), justify="left" if is_text else "right", overflow="fold")
    for row in table.sort_values(["setting", "planner"], key=_place, kind="stable").head(N_SHOWN).to_dict("records"):
        view.add_row(*(escape(_cell(row, str(name))) for name in shown))
    show(view)
    if len(table) > N_SHOWN:
        print(f"... and {len(table) - N_SHOWN} more")


def _place(column: pd.Series) -> pd.Series:
    """Of each value, the place at which it comes first among the others."""
    return column.map({value: place for place, value in enumerate(column.unique())})


def _cell(row: dict, name: str) -> str:
    value = row[name]
    if not isinstance(value, float):
        return str(value)
    if np.isnan(value):
        return "-"
    scale, unit = (100, " %") if name in RATES.values() else (1, "")
    low, high = row.get(f"{name}_low", np.nan), row.get(f"{name}_high", np.nan)
    interval = "" if np.isnan(low) else f" [{scale * low:.2f}, {scale * high:.2f}]"
    return f"{scale * value:.2f}{unit}{interval}"
