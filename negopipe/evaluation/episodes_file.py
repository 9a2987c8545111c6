"""episodes.csv: a row per evaluated episode of every planner; each column is one entry of `COLUMNS`.

The terms are those of docs/reading.md, "suspend number", "driving time" and "deadlock".
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from negopipe.evaluation.horizon_text import to_text
from negopipe.evaluation.metrics import mean_over, passes_first, running, suspensions
from negopipe.evaluation.safety import (
    avoidable_by,
    contact_speed,
    footprints,
    largest_decel_and_jerk,
    smallest_gap,
    smallest_ttc,
)
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.simulation.geometry import Boxes
from negopipe.simulation.state import EGO, NEAREST
from negopipe.tracking.csv_file import CsvKind

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig


@dataclass(frozen=True)
class Drives:
    """Evaluated episodes and the constants that their columns are computed with.

    trace: E episodes of one planner in one setting
    braking_mps2: full braking, m/s2
    plan_s: length of a plan, s
    """

    trace: Trace
    braking_mps2: float
    plan_s: float

    @staticmethod
    def of(config: "RunConfig", trace: Trace) -> "Drives":
        """The constants of a run's config."""
        planner = config.planner
        return Drives(trace, planner.limits.full_braking_mps2, planner.horizon_s)

    @cached_property
    def is_running(self) -> np.ndarray:
        """[T, E] bool, see `running`."""
        return running(self.trace)

    @cached_property
    def time_s(self) -> np.ndarray:
        """[E, V] s until a vehicle reached its target; NaN if it did not."""
        return np.where(self.trace.reached_step >= 0, self.trace.reached_step * self.trace.dt_s, np.nan)

    @cached_property
    def suspensions(self) -> tuple[np.ndarray, np.ndarray]:
        """Count and time [E] each, see `suspensions`."""
        return suspensions(self.trace)

    @cached_property
    def boxes(self) -> Boxes:
        """Footprints, fields [T+1, E, V]."""
        return footprints(self.trace)

    @cached_property
    def largest(self) -> tuple[np.ndarray, np.ndarray]:
        """Deceleration and jerk [E] each, see `largest_decel_and_jerk`."""
        return largest_decel_and_jerk(self.trace)


@dataclass(frozen=True)
class EpisodeColumn:
    """One column of episodes.csv.

    name: its heading, with the unit
    type_: of its cells
    values: Drives of E episodes -> [E] values, or one value for all of them
    meaning: definition in one sentence
    """

    name: str
    type_: type
    values: Callable[[Drives], Any]
    meaning: str


COLUMNS = (
    EpisodeColumn("planner", str, lambda d: d.trace.planner, "name of the planner"),
    EpisodeColumn("setting", str, lambda d: d.trace.setting, "name of the evaluated setting"),
    EpisodeColumn("episode", int, lambda d: np.arange(len(d.trace.n_steps)), "index of the task in its setting"),
    EpisodeColumn(
        "ego_start_distance_m", float, lambda d: d.trace.start_distance_m[:, EGO], "start distance of the ego"
    ),
    EpisodeColumn(
        "social_start_distance_m",
        float,
        lambda d: d.trace.start_distance_m[:, NEAREST],
        "start distance of the nearest social vehicle",
    ),
    EpisodeColumn(
        "style_horizon_s", float, lambda d: d.trace.style_horizon_s[:, NEAREST], "style of the nearest social vehicle"
    ),
    EpisodeColumn("social_driver", str, lambda d: d.trace.driver[:, NEAREST], "driver of the nearest social vehicle"),
    EpisodeColumn(
        "outcome",
        str,
        lambda d: np.array(OUTCOMES)[d.trace.outcome],
        "success (all vehicles arrive without a collision), collision, deadlock, timeout or social_collision",
    ),
    EpisodeColumn("n_decisions", int, lambda d: d.trace.n_steps, "decisions until the episode ended"),
    EpisodeColumn("ego_time_s", float, lambda d: d.time_s[:, EGO], "time until the ego reached its target; or empty"),
    EpisodeColumn(
        "social_time_s",
        float,
        lambda d: d.time_s[:, NEAREST],
        "time until the nearest social vehicle reached its target; or empty",
    ),
    EpisodeColumn(
        "driving_time_s", float, lambda d: d.time_s[:, EGO], "ego_time_s under the name of the paper's figure"
    ),
    EpisodeColumn(
        "suspend_count", int, lambda d: d.suspensions[0], "stops of the ego after it moved and before it arrived"
    ),
    EpisodeColumn("suspend_time_s", float, lambda d: d.suspensions[1], "time at rest in these stops"),
    EpisodeColumn(
        "reward",
        float,
        lambda d: (d.trace.reward * d.is_running).sum(0, dtype=np.float64),
        "undiscounted sum of Eq. 3",
    ),
    EpisodeColumn(
        "full_braking_count",
        int,
        lambda d: (d.trace.is_full_braking[:, :, EGO] & d.is_running).sum(0),
        "decisions of the ego without a feasible plan",
    ),
    EpisodeColumn(
        "intervention_count",
        int,
        lambda d: ((d.trace.intervention > 0) & d.is_running).sum(0),
        "decisions in which the safety layer replaced the plan of the ego",
    ),
    EpisodeColumn(
        "mean_horizon_s",
        float,
        lambda d: mean_over(np.minimum(d.trace.horizon_s[:, :, EGO], d.plan_s), d.is_running),
        "mean prediction horizon of the ego, an infinite one counted as planner.horizon_s; empty where it has none",
    ),
    EpisodeColumn(
        "passes_first",
        str,
        lambda d: passes_first(d.trace),
        "vehicle whose centre left the corridor first: ego, social or none",
    ),
    EpisodeColumn(
        "horizons",
        str,
        lambda d: to_text(d.trace.horizon_s[:, :, EGO], d.trace.n_steps),
        "horizons of the ego, decision by decision, as `negopipe.evaluation.horizon_text` writes them",
    ),
    EpisodeColumn(
        "smallest_gap_m",
        float,
        lambda d: smallest_gap(d.boxes),
        "smallest distance of the ego's footprint to a social vehicle's; 0 in a collision",
    ),
    EpisodeColumn(
        "smallest_ttc_s",
        float,
        lambda d: smallest_ttc(d.trace, d.boxes),
        "smallest time to collision at constant velocities; empty without a collision course",
    ),
    EpisodeColumn("largest_decel_mps2", float, lambda d: d.largest[0], "largest deceleration of the ego"),
    EpisodeColumn("largest_jerk_mps3", float, lambda d: d.largest[1], "largest absolute jerk of the ego"),
    EpisodeColumn(
        "avoidable_by",
        str,
        lambda d: avoidable_by(d.trace, d.braking_mps2),
        "vehicle that full braking would have kept out of the collision: ego, social, both, nobody; alone: the ego "
        "touched no vehicle; none: no collision",
    ),
    EpisodeColumn(
        "contact_speed_mps", float, lambda d: contact_speed(d.trace), "speed of the ego as it collided; or empty"
    ),
)
"""Columns in the order of the file."""

EPISODES_NAME = "episodes.csv"
EPISODES = CsvKind("the stage `evaluate`", {column.name: column.type_ for column in COLUMNS})


def episodes(drives: Drives, names: Collection[str] | None = None) -> pd.DataFrame:
    """A row per episode, with all `COLUMNS` or those in `names`."""
    return pd.DataFrame({c.name: c.values(drives) for c in COLUMNS if names is None or c.name in names})
