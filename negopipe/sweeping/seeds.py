"""What training seeds came to, and how surely: `python -m negopipe.sweeping.seeds outputs/yield`.

Reads the episodes.csv of the runs of one config with several seeds and, for the regret, an oracle.csv; prints three
tables and writes them to `outputs/sweeps/<name>/`:

seeds.csv   a row per seed, setting and planner: rates with Wilson intervals, reward, regret to the oracle
across.csv  a row per setting and planner: interquartile means across seeds, with bootstrap intervals
styles.csv  a row per setting, style of the other driver and planner, seeds pooled; the policy's success less the
            planner's on the same tasks, and the regret
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from negopipe.errors import UserError
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME
from negopipe.evaluation.statistics import Estimate, interquartile_mean, mean_difference, rate
from negopipe.evaluation.trace import ADAPTIVE
from negopipe.search.oracle_table import ORACLE_TABLE
from negopipe.sweeping.swept_runs import read_runs
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv
from negopipe.tracking.run_folder import CONFIG_NAME

RATES = {"success": "success_rate", "collision": "collision_rate"}
"""Outcomes that are counted, and what their shares are called."""
NEEDED = (
    *("planner", "setting", "episode", "social_start_distance_m", "style_horizon_s"),
    *("outcome", "driving_time_s", "reward"),
)
"""Columns of episodes.csv that are looked at."""
_WHO = {"setting": str, "planner": str}
_MADE_BY = "negopipe.sweeping.seeds"
KINDS = {
    "seeds": CsvKind(_MADE_BY, {"seed": int, **_WHO, "n_episodes": int, "*": float}),
    "across": CsvKind(_MADE_BY, {**_WHO, "n_seeds": int, "*": float}),
    "styles": CsvKind(_MADE_BY, {"style_s": str, **_WHO, "n_tasks": int, "*": float}),
}
"""The tables that it writes; a row of all styles has `all` for its style."""
RANDOM_SEED = 0
"""Of the bootstrap: the same runs give the same intervals."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 1 after a line that says what is wrong."""
    parser = argparse.ArgumentParser(prog="python -m negopipe.sweeping.seeds", description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="outputs/<name>: the folder that holds the runs")
    parser.add_argument("--sweep", help="only runs with this tag `sweep`")
    parser.add_argument("--oracle", type=Path, help="oracle.csv of +experiment=oracle, for the regret")
    given = parser.parse_args(arguments)
    try:
        episodes = read_episodes(given.folder, given.sweep)
        oracle = None if given.oracle is None else _read_oracle(given.oracle)
        seeds = by_seed(episodes, oracle)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    target = given.folder.parent / "sweeps" / (given.sweep or given.folder.name)
    target.mkdir(parents=True, exist_ok=True)
    for name, table in {"seeds": seeds, "across": across_seeds(seeds), "styles": by_style(episodes, oracle)}.items():
        write_csv(target / f"{name}.csv", table, KINDS[name])
        _show(table)
        print(f"{name:10} {target / name}.csv")
    return 0


def read_episodes(folder: Path, sweep: str | None = None) -> pd.DataFrame:
    """Rows of `negopipe.evaluation.metrics.episodes` of all runs in `folder`, with a column `seed`.

    The planners that are not trained drive alike in every run, so one run that has them is enough.

    Raises UserError if no run is evaluated, if two have the same seed or if their policies drove different tasks.
    """
    runs = [run for run in read_runs(folder, sweep) if (folder / run.name / EPISODES_NAME).exists()]
    if not runs:
        raise UserError(f"{folder}: no run in it has been evaluated")
    return read_tables([folder / run.name for run in runs])


def read_tables(folders: Sequence[Path]) -> pd.DataFrame:
    """The same of evaluated runs of one config, which may lie apart."""
    place = folders[0].parent
    seeds = [_seed(folder) for folder in folders]
    if len(set(seeds)) < len(seeds):
        raise UserError(f"{place}: must hold one run per seed (--sweep picks some), got seeds {seeds}")
    tables = [read_csv(folder / EPISODES_NAME, EPISODES, NEEDED) for folder in folders]
    tasks = [_tasks(table) for table in tables]
    for folder, own in zip(folders[1:], tasks[1:], strict=True):
        if not own.equals(tasks[0]):
            raise UserError(f"{place}: {folder.name} drove other tasks than {folders[0].name}; evaluate them alike")
    return pd.concat([table.assign(seed=seed) for seed, table in zip(seeds, tables, strict=True)], ignore_index=True)


def _seed(folder: Path) -> int:
    return int(yaml.safe_load((folder / CONFIG_NAME).read_text(encoding="utf-8"))["seed"])


def _tasks(episodes: pd.DataFrame) -> pd.DataFrame:
    """What the policy of one run drove."""
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


def _read_oracle(path: Path) -> pd.DataFrame:
    if not path.is_file():
        raise UserError(f"--oracle must be an oracle.csv, got {path}: no such file")
    return read_csv(path, ORACLE_TABLE, ("setting", "episode", "social_start_distance_m", "reward"))


def _named(name: str, estimate: Estimate) -> dict[str, float]:
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}


def _show(table: pd.DataFrame) -> None:
    """An estimate and its interval in one cell."""
    shown = [name for name in table if not str(name).endswith(("_low", "_high"))]
    view = Table()
    for name in shown:
        view.add_column(str(name), justify="left" if table[name].dtype == object else "right", overflow="fold")
    for row in table.to_dict("records"):
        view.add_row(*(escape(_cell(row, str(name))) for name in shown))
    console = Console()
    (console if console.is_terminal else Console(width=160)).print(view)


def _cell(row: dict, name: str) -> str:
    value = row[name]
    if not isinstance(value, float):
        return str(value)
    if np.isnan(value):
        return "-"
    scale, form = (100, "{:.2f}") if name in (*RATES.values(), "lead") else (1, "{:.2f}")
    unit = " %" if scale == 100 else ""
    low, high = row.get(f"{name}_low", np.nan), row.get(f"{name}_high", np.nan)
    interval = "" if np.isnan(low) else f" [{form.format(scale * low)}, {form.format(scale * high)}]"
    return f"{form.format(scale * value)}{unit}{interval}"


if __name__ == "__main__":
    sys.exit(main())
