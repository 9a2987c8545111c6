"""Files of a run folder that the report reads, in the order of the page."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from negopipe.errors import UserError
from negopipe.evaluation.trace import ADAPTIVE, Trace

RESULTS = ("evaluation", "versus_adaptive", "regret")
"""Parts of metrics.json on the page."""


def read_metrics(folder: Path) -> dict[str, Any]:
    path = folder / "metrics.json"
    metrics = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    if not set(RESULTS) <= metrics.keys():
        raise UserError(f"{path}: no results of an evaluation; run the stage `evaluate` first")
    return metrics


def pick(by_planner: Mapping[str, Any], planners: Sequence[str]) -> dict[str, Any]:
    """The entries in the order of the planners, which JSON has sorted."""
    return {planner: by_planner[planner] for planner in planners if planner in by_planner}


def in_order(table: pd.DataFrame, settings: list[str]) -> pd.DataFrame:
    """Rows in the order of the settings, planners in their order."""
    return pd.concat([table[table["setting"] == setting] for setting in settings], ignore_index=True)


def by_setting(traces: list[Trace], settings: list[str], planners: Sequence[str]) -> dict[str, list[Trace]]:
    """Traces of each setting; UserError if one of `planners` is missing."""
    grouped = {setting: [trace for trace in traces if trace.setting == setting] for setting in settings}
    for group in grouped.values():
        named(group, planners)
        _check_same_tasks(group)
    return grouped


def _check_same_tasks(group: list[Trace]) -> None:
    """One episode number is one task for all planners that drove it, since they are shown side by side."""
    first = group[0]
    for trace in group[1:]:
        own, other = (each.first(min(len(trace.n_steps), len(first.n_steps))) for each in (trace, first))
        is_same = np.array_equal(own.start_distance_m, other.start_distance_m)
        is_same &= np.array_equal(own.style_horizon_s, other.style_horizon_s, equal_nan=True)
        is_same &= np.array_equal(own.driver, other.driver)
        if not is_same:
            planners = f"{first.planner} and {trace.planner}"
            raise UserError(f"traces.npz: {planners} drove different tasks in {first.setting}; evaluate them anew")


def adaptive_of(group: list[Trace]) -> Trace:
    return named(group, [ADAPTIVE])[0]


def named(group: list[Trace], planners: Sequence[str]) -> list[Trace]:
    by_name = {trace.planner: trace for trace in group}
    for planner in planners:
        if planner not in by_name:
            known = ", ".join(by_name) or "none"
            raise UserError(f"report.side_by_side must name planners of traces.npz ({known}), got {planner}")
    return [by_name[planner] for planner in planners]
