"""Cross-play: every driver of the population as the ego against every driver on the other side, on the same tasks."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch

from negopipe.agents.population import PlannerStyle, PopulationConfig
from negopipe.checks import Memory, Problem
from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.statistics import Estimate, rate
from negopipe.evaluation.trace import trace_bytes
from negopipe.schema import PositiveInt, schema
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.state import EGO, NEAREST, Task
from negopipe.tracking.csv_file import CsvKind

RATES = ("success", "collision", "ego_first")
"""Shares with intervals."""

CROSS_PLAY = CsvKind(
    "the stage `cross_play`",
    {
        "setting": str,
        "ego": str,
        "social": str,
        "n_episodes": int,
        **{f"{name}_{part}": float for name in RATES for part in ("rate", "low", "high")},
        "deadlock_rate": float,
        "ego_time_s": float,
        "social_time_s": float,
        "suspend_time_s": float,
        "smallest_gap_m": float,
    },
)
"""cross_play.csv: a row per `cell`."""

MEASURED = ("outcome", "ego_time_s", "social_time_s", "suspend_time_s", "passes_first", "smallest_gap_m")
"""Columns of episodes.csv that a cell aggregates."""


@schema
class CrossPlayConfig:
    """`conf/cross_play/all_pairs.yaml` says what each value means."""

    n_episodes: PositiveInt
    is_symmetric: bool

    def check(self, population: PopulationConfig) -> Iterator[Problem]:
        for name, planner in population.planners.items():
            if not planner.is_own and population.drivers[name].weight > 0:
                rule = "have horizons_s or interval_s for the stage cross_play, where families give the ego no style"
                yield Problem(f"population.drivers.{name}.driver", rule, describe(planner))

    def memory(self, scenario: ScenarioConfig) -> Memory:
        """Memory of the trace of one pair."""
        n_bytes = trace_bytes(self.n_episodes, scenario.episode_steps, scenario.n_vehicles)
        keys = "cross_play.n_episodes scenario.episode_steps scenario.n_social scenario.n_followers"
        return Memory("cross-play", n_bytes, tuple(keys.split()))


def describe(planner: PlannerStyle) -> str:
    """The values of a planner that say whose horizons it takes."""
    return f"horizons_s {planner.horizons_s}, interval_s {planner.interval_s}"


def symmetric(task: Task) -> Task:
    """The tasks with the nearest oncoming vehicle as far from its mouth, as fast and as large as the ego."""

    def as_ego(field: torch.Tensor) -> torch.Tensor:
        return field.index_copy(1, torch.tensor([NEAREST], device=field.device), field[:, [EGO]])

    return replace(
        task,
        start_distance=as_ego(task.start_distance),
        start_speed=as_ego(task.start_speed),
        desired_speed=as_ego(task.desired_speed),
        length=as_ego(task.length),
        width=as_ego(task.width),
    )


def cell(drives: Drives, ego: str, social: str) -> dict[str, Any]:
    """One row of cross_play.csv: the episodes of one driver of the ego against one on the other side.

    success, collision: shares of the episodes; ego_first: share of the episodes with a first passage in which the ego
        passes first, NaN without one; each with its score interval of 95 %
    deadlock_rate: share of the episodes
    ego_time_s, social_time_s: mean times until the target was reached, over arrivals; NaN without an arrival
    suspend_time_s, smallest_gap_m: means of the ego over all episodes
    """
    rows = episodes(drives, MEASURED)
    first = rows.loc[rows["passes_first"] != "none", "passes_first"]
    shares = {
        "success": rate((rows["outcome"] == "success").to_numpy()),
        "collision": rate((rows["outcome"] == "collision").to_numpy()),
        "ego_first": rate((first == "ego").to_numpy()) if len(first) else Estimate(*[float("nan")] * 3),
    }
    row: dict[str, Any] = {"setting": drives.trace.setting, "ego": ego, "social": social, "n_episodes": len(rows)}
    for name, share in shares.items():
        row |= {f"{name}_rate": share.value, f"{name}_low": share.low, f"{name}_high": share.high}
    row["deadlock_rate"] = float((rows["outcome"] == "deadlock").mean())
    means = ("ego_time_s", "social_time_s", "suspend_time_s", "smallest_gap_m")
    return row | {name: float(rows[name].mean()) for name in means}
