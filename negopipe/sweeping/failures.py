"""The failed tasks of unseen-v1: how they came about, as a table, and a film of one per case."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from omegaconf import OmegaConf
from pydantic import TypeAdapter

from negopipe.evaluation.failures import failures
from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.trace import ADAPTIVE, Trace
from negopipe.report import animation
from negopipe.report.captions import caption
from negopipe.report.labels import outcome_label, planner_label
from negopipe.report.page import FigureItem
from negopipe.report.scene import Scene, scene_of
from negopipe.simulation.build_road import build_road
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.tracking.csv_file import CsvKind
from negopipe.tracking.run_folder import CONFIG_NAME

FPS = 2
BY = ("case", "planner", "outcome", "cause")
COUNTS = ("n_tasks", "first_task", "n_kept")
FAILURES = CsvKind("python -m negopipe.sweeping.unseen", dict.fromkeys(BY, str) | dict.fromkeys(COUNTS, int))
"""unseen_failures.csv, a row per cause: tasks that failed by it, the first of them, and tasks whose drive is kept."""


class Drives(NamedTuple):
    """Drives of one run that are kept: its case, its folder, planner -> trace."""

    case: str
    folder: Path
    traces: Mapping[str, Trace]


def failure_table(drives: Sequence[Drives]) -> pd.DataFrame:
    """Rows of `FAILURES`; of a case and planner the most frequent cause first."""
    rows = [
        (each.case, planner, found.outcome, found.cause, found.episode, len(trace.n_steps))
        for each in drives
        for planner, trace in each.traces.items()
        for found in failures(trace)
    ]
    causes = pd.DataFrame(rows, columns=[*BY, "task", "n_kept"]).groupby([*BY], as_index=False, sort=False)
    table = causes.agg(n_tasks=("task", "size"), first_task=("task", "min"), n_kept=("n_kept", "first"))
    return table.sort_values(["case", "planner", "n_tasks"], ascending=[True, True, False], kind="stable")


def failure_films(
    drives: Sequence[Drives], table: pd.DataFrame, reference: str, fixed_s: FixedHorizons
) -> list[FigureItem]:
    """Per case, and policy where there are several, a failure by its most frequent cause, beside the reference.

    table: of `failure_table`
    """
    items = []
    for each in drives:
        for planner in (name for name in each.traces if name.startswith(ADAPTIVE)):
            causes = table[(table["case"] == each.case) & (table["planner"] == planner)]
            if len(causes):
                shown = [each.traces[name] for name in (planner, reference) if name in each.traces]
                items.append(_film(each, shown, causes, fixed_s))
    return items


def _film(drives: Drives, shown: Sequence[Trace], causes: pd.DataFrame, fixed_s: FixedHorizons) -> FigureItem:
    first, trace = causes.iloc[0], shown[0]
    task = int(first["first_task"])
    scene = _scene(drives.folder, int(trace.street[task]))
    gif = animation.animate(shown, task, scene, FPS, fixed_s)
    still = animation.still(shown, task, scene, trace.n_steps[task] * trace.dt_s, fixed_s)
    title, reading = caption(
        "failure",
        case=drives.case.replace("_", " "),
        task=task,
        planners=", ".join(planner_label(each.planner, fixed_s) for each in shown),
        outcome=outcome_label(first["outcome"]).capitalize(),
        cause=first["cause"],
        n_failed=causes["n_tasks"].sum(),
        n_kept=first["n_kept"],
        causes="; ".join(f"{row.n_tasks} x {row.cause}" for row in causes.itertuples()),
    )
    return FigureItem(title, reading, gif, still)


def _scene(folder: Path, street: int) -> Scene:
    """A street of a run, by its config."""
    values: Any = OmegaConf.to_container(OmegaConf.load(folder / CONFIG_NAME))
    scenario = TypeAdapter(ScenarioConfig).validate_json(json.dumps(values["scenario"]), strict=True)
    return scene_of(build_road(scenario), street, values["planner"]["horizon_s"])
