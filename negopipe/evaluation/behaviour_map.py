"""The behaviour map: results of every pair of an ego's horizon and an opponent, and the test of claim 8 on them.

An opponent is a style of the planner, or a driver of the population.

Claim 8: a shorter prediction horizon gives more aggressive driving, that is passing first more often and coming closer
(docs/reading.md, "claim 8").
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import Field

from negopipe.checks import Foresight, Memory, Problem, check_horizons
from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.trace import OUTCOMES, trace_bytes
from negopipe.schema import Distinct, Horizon, PositiveInt, schema
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.tracking.csv_file import CsvKind

BEHAVIOUR_MAP = CsvKind(
    "the stage `behaviour_map`",
    {
        "setting": str,
        "ego_horizon_s": float,
        "social_style_s": float,
        "social_driver": str,
        "n_episodes": int,
        "success_rate": float,
        "collision_rate": float,
        "deadlock_rate": float,
        "other_timeout_rate": float,
        "social_collision_rate": float,
        "ego_time_s": float,
        "social_time_s": float,
        "suspend_count": float,
        "suspend_time_s": float,
        "ego_passes_first_rate": float,
        "smallest_gap_m": float,
        "full_braking_rate": float,
    },
)
"""behaviour_map.csv: a row per `cell`."""
NEEDED = tuple(column for column in BEHAVIOUR_MAP.columns if column != "social_driver")
"""Columns of every map: those of earlier versions know no drivers."""

MEASURED = (
    *("outcome", "n_decisions", "ego_time_s", "social_time_s", "suspend_count", "suspend_time_s"),
    *("full_braking_count", "passes_first", "smallest_gap_m"),
)
"""Columns of episodes.csv that a cell aggregates."""

DifferentHorizons = Annotated[list[Horizon], Field(min_length=1), Distinct]


@schema
class BehaviourMapConfig:
    """`conf/behaviour_map/all_pairs.yaml` says what each value means."""

    horizons_s: DifferentHorizons
    styles_s: DifferentHorizons
    n_episodes: PositiveInt

    def check(self, dt_s: float, foresight: Foresight) -> Iterator[Problem]:
        """foresight: of the planner."""
        horizons_s = {"behaviour_map.horizons_s": self.horizons_s, "behaviour_map.styles_s": self.styles_s}
        yield from check_horizons(horizons_s, dt_s, foresight)

    def memory(self, scenario: ScenarioConfig) -> Memory:
        """Memory of the trace of one pair of horizons."""
        n_bytes = trace_bytes(self.n_episodes, scenario.episode_steps, scenario.n_vehicles)
        keys = "behaviour_map.n_episodes scenario.episode_steps scenario.n_social scenario.n_followers"
        return Memory("the map", n_bytes, tuple(keys.split()))


class Opponent(NamedTuple):
    """Who drives the social vehicles: the planner with one style, or a driver of the population.

    style_s: NaN for a driver of the population
    driver: its name; empty for a style
    """

    style_s: float
    driver: str


def cell(drives: Drives, ego_horizon_s: float, opponent: Opponent) -> dict[str, Any]:
    """One row of the map: the episodes of one horizon of the ego against one opponent.

    setting, ego_horizon_s, social_style_s, social_driver, n_episodes
    success_rate, collision_rate, deadlock_rate, other_timeout_rate, social_collision_rate: shares of the episodes,
        which sum to 1
    ego_time_s, social_time_s: mean times until the target was reached, over arrivals; NaN without an arrival
    suspend_count, suspend_time_s: means of the ego over all episodes
    ego_passes_first_rate: share of the episodes with a first passage in which the ego passes first; NaN without one
    smallest_gap_m: mean over all episodes
    full_braking_rate: share of the ego's decisions without a feasible plan
    """
    rows = episodes(drives, MEASURED)
    share = {outcome: float((rows["outcome"] == outcome).mean()) for outcome in OUTCOMES}
    first = rows["passes_first"][rows["passes_first"] != "none"]
    return {
        "setting": drives.trace.setting,
        "ego_horizon_s": ego_horizon_s,
        "social_style_s": opponent.style_s,
        "social_driver": opponent.driver,
        "n_episodes": len(rows),
        "success_rate": share["success"],
        "collision_rate": share["collision"],
        "deadlock_rate": share["deadlock"],
        "other_timeout_rate": share["timeout"],
        "social_collision_rate": share["social_collision"],
        "ego_time_s": float(rows["ego_time_s"].mean()),
        "social_time_s": float(rows["social_time_s"].mean()),
        "suspend_count": float(rows["suspend_count"].mean()),
        "suspend_time_s": float(rows["suspend_time_s"].mean()),
        "ego_passes_first_rate": float((first == "ego").mean()),
        "smallest_gap_m": float(rows["smallest_gap_m"].to_numpy().mean()),
        "full_braking_rate": float(rows["full_braking_count"].sum() / rows["n_decisions"].sum()),
    }


HOLDS, FAILS, EQUAL, UNKNOWN = "holds", "does not hold", "no difference", "undecided"
"""Verdicts: the measure changes in the claimed direction or not at all from each horizon to the next; it changes in the
other direction somewhere; it is the same for all; fewer than two horizons have a value."""

CLAIMED = {"ego_passes_first_rate": (-1, 1e-9), "smallest_gap_m": (1, 0.01)}
"""Measure -> the claimed sign of its change with a longer horizon of the ego, and the change that counts as none."""


@dataclass(frozen=True)
class Trend:
    """Claim 8 for one measure, in one setting against one style.

    turn: ((horizon, value), (next horizon, value)), the largest step against the claim; None unless the claim fails
    """

    setting: str
    social_style_s: float
    measure: str
    verdict: str
    turn: tuple[tuple[float, float], tuple[float, float]] | None


def trends(table: pd.DataFrame) -> list[Trend]:
    """Claim 8 for every measure, setting and style, from rows of `cell`.

    An infinite horizon of the ego is left out: it has a rule of its own, and the claim is about lengths. So are the
    drivers of a population, which have no style.
    """
    found = []
    for measure, (sign, tolerance) in CLAIMED.items():
        for (setting, style_s), rows in table.groupby(["setting", "social_style_s"], sort=False):
            finite = rows[rows["ego_horizon_s"] < math.inf]
            known = finite.dropna(subset=measure).sort_values("ego_horizon_s")
            points = list(zip(known["ego_horizon_s"].tolist(), known[measure].tolist(), strict=True))
            found.append(Trend(str(setting), float(str(style_s)), measure, *_judge(points, sign, tolerance)))
    return found


def _judge(
    points: Sequence[tuple[float, float]], sign: int, tolerance: float
) -> tuple[str, tuple[tuple[float, float], tuple[float, float]] | None]:
    """Verdict and turn of the points (horizon, value) in the order of the horizons."""
    if len(points) < 2:
        return UNKNOWN, None
    values = np.array([value for _, value in points])
    steps = sign * np.diff(values)
    if np.ptp(values) <= tolerance:
        return EQUAL, None
    worst = int(steps.argmin())
    return (HOLDS, None) if steps[worst] >= -tolerance else (FAILS, (points[worst], points[worst + 1]))


def claims(found: Sequence[Trend]) -> dict[str, Any]:
    """The verdicts for metrics.json: measure -> setting -> `social_<style>` -> verdict."""
    verdicts: dict[str, Any] = {}
    for finding in found:
        by_style = verdicts.setdefault(finding.measure, {}).setdefault(finding.setting, {})
        by_style[f"social_{finding.social_style_s:g}"] = finding.verdict
    return verdicts
