"""Results of unseen-v1 as one table and one page: `python -m negopipe.sweeping.unseen <outputs>`.

The runs of `+experiment=unseen` are read, one per case and policy, and nothing is run.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from negopipe.errors import UserError
from negopipe.evaluation import measures
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME
from negopipe.evaluation.statistics import mean_difference
from negopipe.evaluation.trace import ADAPTIVE, TRACES_NAME, load_traces
from negopipe.report.captions import FAILED, caption
from negopipe.report.case_figures import MAPS, case_map
from negopipe.report.figures import render
from negopipe.report.labels import planner_label
from negopipe.report.page import Chapter, FigureItem, Provenance, Section, build_page
from negopipe.report.style import planner_colors
from negopipe.report.tables import Column, Table, table
from negopipe.sweeping.comparison_page import provenance
from negopipe.sweeping.failures import FAILURES, Drives, failure_films, failure_table
from negopipe.sweeping.swept_runs import SweptRun, find_folders, read_runs
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv
from negopipe.tracking.whole_file import write_whole

COMMAND = "python -m negopipe.sweeping.unseen"
SUITE = "unseen-v1"
REFERENCE = "cautious"
"""Planner that all others are compared with, task by task."""
POLICY = ("checkpoint", "evaluation.action")
"""Keys that tell the policies apart."""
CAR = ("planner.", "safety.", "perception.", "dynamics.")
"""Beginnings of keys that are the same for every planner of a case."""
RANDOM_SEED = 0
"""Seed of the bootstrap: the same runs give the same intervals."""
FIGURES = (
    *("success_rate", "success_low", "success_high", "collision_rate", "collision_low", "collision_high"),
    *("avoidable_by_ego_rate", "avoidable_by_both_rate", "avoidable_by_social_rate", "deadlock_rate", "timeout_rate"),
    *("driving_time_s", "ego_first_rate", "reward"),
    *("smallest_gap_m", "smallest_ttc_s", "largest_decel_mps2", "full_braking_count"),
)
"""Measures of a planner in a case, in the order of the table."""
ROWS = CsvKind(COMMAND, {"case": str, "planner": str, "n_episodes": int, "*": float}, "%.5g")
"""unseen.csv."""
MEANS = (
    *("success_rate", "collision_rate", "avoidable_by_ego_rate", "avoidable_by_both_rate", "deadlock_rate"),
    *("driving_time_s", "time_s_vs_cautious", "solved_by_any"),
)
OF_ALL = CsvKind(COMMAND, {"planner": str, "n_cases": int, "*": float}, "%.5g")
"""unseen_means.csv: means over the cases, each case alike."""
OVERALL = (
    Column("success [%]", "success_rate", 100, 1, "max"),
    Column("least of a case [%]", "least_success", 100, 1, "max"),
    Column("collision [%]", "collision_rate", 100, 2, "min"),
    Column("most of a case [%]", "most_collisions", 100, 1, "min"),
    Column("avoidable by the ego alone [%]", "avoidable_by_ego_rate", 100, 2, "min"),
    Column("avoidable by either [%]", "avoidable_by_both_rate", 100, 2, "min"),
    Column("deadlock [%]", "deadlock_rate", 100, 2, "min"),
    Column("driving time [s]", "driving_time_s", 1, 2, "min"),
    Column("cases", "n_cases", 1, 0),
)


class Cases(NamedTuple):
    """Episodes of all planners in all cases.

    episodes: rows of the runs' episodes.csv with the column `case`; a policy has a number where there are several
    fixed_s: horizon of each baseline that has a fixed one
    """

    episodes: pd.DataFrame
    fixed_s: Mapping[str, float]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 1 after a line that says what is wrong."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("outputs", type=Path, help="outputs folder of the runs, such as outputs/unseen-v1")
    given = parser.parse_args(arguments)
    try:
        write_results(given.outputs, f"{COMMAND} {given.outputs}")
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def write_results(outputs: Path, command: str) -> None:
    """Write the tables and unseen.html into the outputs folder, and print the means over the cases."""
    runs = [run for run in read_runs(find_folders([outputs / f"{SUITE}.*"])) if run.holds(EPISODES_NAME)]
    if not runs:
        raise UserError(f"the folder must hold evaluated runs of +experiment=unseen, got {outputs}")
    _require_one_car(runs)
    cases = read_cases(runs)
    rows = case_table(cases.episodes)
    write_csv(outputs / "unseen.csv", rows, ROWS)
    overall = over_cases(rows)
    means = pd.DataFrame([{"planner": planner} | values for planner, values in overall.items()])
    write_csv(outputs / "unseen_means.csv", means, OF_ALL)
    drives = read_drives(runs)
    failed = failure_table(drives)
    write_csv(outputs / "unseen_failures.csv", failed, FAILURES)
    print("films      of a failure per case")
    films = failure_films(drives, failed, REFERENCE, cases.fixed_s)
    page = _page(cases, rows, overall, films, provenance(runs, command))
    write_whole(outputs / "unseen.html", page.encode())
    for name, values in overall.items():
        figures = f"success {values['success_rate']:7.2%}  collision {values['collision_rate']:6.2%}"
        print(f"{name:24} {figures}  {values['n_cases']} cases")
    print(f"table      {outputs / 'unseen.csv'}\npage       {outputs / 'unseen.html'}")


def read_cases(runs: Sequence[SweptRun]) -> Cases:
    """The episodes of all runs; of a baseline that several runs of a case drove, those of the first one."""
    parts, seen = [], set()
    fixed_s: dict[str, float] = {}
    for run, own in _with_policies(runs):
        case = _case(run)
        episodes = read_csv(run.folder / EPISODES_NAME, EPISODES).replace({"planner": {ADAPTIVE: own}})
        for planner, rows in episodes.groupby("planner", sort=False):
            if (case, planner) not in seen:
                seen.add((case, planner))
                parts.append(rows.assign(case=case))
        fixed_s |= _fixed(run.config)
    return Cases(pd.concat(parts, ignore_index=True), fixed_s)


def read_drives(runs: Sequence[SweptRun]) -> list[Drives]:
    """The drives that the runs have kept, under the names of `read_cases`."""
    found, seen = [], set()
    for run, own in _with_policies(runs):
        if run.holds(TRACES_NAME):
            traces = {own if t.planner == ADAPTIVE else t.planner: t for t in load_traces(run.folder / TRACES_NAME)}
            new = {planner: trace for planner, trace in traces.items() if (_case(run), planner) not in seen}
            seen |= {(_case(run), planner) for planner in new}
            found.append(Drives(_case(run), run.folder, new))
    return found


def _case(run: SweptRun) -> str:
    return str(run.config["name"]).removeprefix(f"{SUITE}.")


def _require_one_car(runs: Sequence[SweptRun]) -> None:
    """Raise a UserError where the runs of a case differ in more than the policy; a baseline would then be several."""
    first: dict[str, SweptRun] = {}
    for run in runs:
        other = first.setdefault(_case(run), run)
        for key in (key for key in run.config if key.startswith(CAR)):
            if run.config[key] != other.config.get(key):
                found = f"{other.config.get(key)} and {run.config[key]} for {_case(run)}"
                raise UserError(f"{key} must be the same in all runs of a case, got {found}; give each its own outputs")


def _with_policies(runs: Sequence[SweptRun]) -> list[tuple[SweptRun, str]]:
    """Every run with the name of its policy, which has a number where the runs have several."""
    of_run = [tuple(str(run.config.get(key)) for key in POLICY) for run in runs]
    policies = list(dict.fromkeys(of_run))
    own = {each: ADAPTIVE if len(policies) == 1 else f"{ADAPTIVE}_{i}" for i, each in enumerate(policies, 1)}
    return [(run, own[policy]) for run, policy in zip(runs, of_run, strict=True)]


def _fixed(config: Mapping[str, Any]) -> dict[str, float]:
    prefix, suffix = "evaluation.baselines.", ".horizon_s"
    keys = [key for key in config if key.startswith(prefix) and key.endswith(suffix)]
    return {key.removeprefix(prefix).removesuffix(suffix): float(config[key]) for key in keys}


def case_table(episodes: pd.DataFrame) -> pd.DataFrame:
    """A row per case and planner: its measures, its share of the tasks that any planner solved, and its paired
    differences from `cautious`, with bootstrap intervals.
    """
    rng, rows = np.random.default_rng(RANDOM_SEED), []
    for case, tasks in episodes.groupby("case", sort=True):
        outcomes = tasks.pivot(index="episode", columns="planner", values="outcome")
        times = tasks.pivot(index="episode", columns="planner", values="driving_time_s")
        is_solvable = (outcomes == "success").any(axis=1)
        own = tasks.assign(setting=case)
        for planner, values in measures.summary(own)["evaluation"][case].items():
            is_success = outcomes[planner] == "success"
            rows.append(
                {"case": case, "planner": planner, "n_episodes": values["n_episodes"]}
                | {name: values[name] for name in FIGURES}
                | {"solved_by_any": is_solvable.mean(), "share_of_solved": is_success[is_solvable].mean()}
                | _versus(outcomes, times, str(planner), rng)
            )
    return pd.DataFrame(rows)


def _versus(outcomes: pd.DataFrame, times: pd.DataFrame, planner: str, rng: np.random.Generator) -> dict[str, float]:
    """Differences from the reference on the same tasks: success, collisions, driving time where both arrive (s)."""
    if REFERENCE not in outcomes:
        return {}
    pairs = {
        outcome: (outcomes == outcome)[[planner, REFERENCE]].dropna().astype(float)
        for outcome in ("success", "collision")
    } | {"time_s": times[[planner, REFERENCE]].dropna()}
    found: dict[str, float] = {}
    for name, both in pairs.items():
        a, b = both.iloc[:, 0].to_numpy(), both.iloc[:, 1].to_numpy()
        stem = f"{name}_vs_{REFERENCE}"
        if len(both):
            estimate = mean_difference(a, b, rng)
            found |= {stem: estimate.value, f"{stem}_low": estimate.low, f"{stem}_high": estimate.high}
    return found


def over_cases(rows: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Planner -> means over its cases, each case alike, and its worst case."""
    return {
        str(planner): own[[name for name in MEANS if name in own]].mean().to_dict()
        | {
            "least_success": own["success_rate"].min(),
            "most_collisions": own["collision_rate"].max(),
            "n_cases": len(own),
        }
        for planner, own in rows.groupby("planner", sort=False)
    }


def _page(
    cases: Cases,
    rows: pd.DataFrame,
    overall: Mapping[str, Mapping[str, float]],
    films: Sequence[FigureItem],
    origin: Provenance,
) -> str:
    labels = {planner: planner_label(planner, cases.fixed_s) for planner in overall}
    colors = planner_colors(list(overall), cases.fixed_s)
    n_cases = rows["case"].nunique()
    over: Table = table("Means over the cases, each case alike", OVERALL, overall, labels, colors)
    n_tasks = " to ".join(map(str, sorted({rows["n_episodes"].min(), rows["n_episodes"].max()})))
    note = f"{n_cases} cases, {n_tasks} tasks each, the same for all planners"
    figures = [
        FigureItem(*caption("cases", measure=MAPS[column][0]), render(case_map(rows, column, labels), "svg"))
        for column in MAPS
    ]
    verdicts = [_verdict(name, overall[name], labels[name]) for name in overall if name.startswith(ADAPTIVE)]
    sections = [Section("Every case", "", figures), *([Section("How it fails", FAILED, films)] if films else [])]
    return build_page(SUITE, verdicts, [Chapter("All cases", note, [over])], [], sections, origin)


def _verdict(name: str, values: Mapping[str, float], label: str) -> tuple[str, str]:
    head = f"{label}: {values['success_rate']:.1%} success and {values['collision_rate']:.2%} collisions on the mean."
    worst = f"at least {values['least_success']:.1%} success and at most {values['most_collisions']:.1%} collisions"
    return head, f"In each of its {values['n_cases']} cases: {worst}."


if __name__ == "__main__":
    sys.exit(main())
