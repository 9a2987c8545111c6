"""The table of driven encounters: a row per car and task, written as they are driven."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from filelock import FileLock

from negopipe.deployment.vehicle.cars import tracked
from negopipe.deployment.vehicle.encounters import Driven
from negopipe.evaluation.episodes_file import COLUMNS, Drives, episodes
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

COMMAND = "python -m negopipe.deployment.vehicle"

OF_EPISODE = (
    "setting", "style_horizon_s", "outcome", "n_decisions", "ego_time_s", "social_time_s", "suspend_time_s",
    "full_braking_count", "intervention_count", "mean_horizon_s", "passes_first", "smallest_gap_m",
    "largest_decel_mps2", "largest_jerk_mps3", "avoidable_by", "contact_speed_mps",
)  # fmt: skip
"""Columns of episodes.csv that the table has, too."""

TRACKING = ("left_rms_m", "left_p95_m", "left_max_m", "ahead_rms_m", "ahead_p95_m", "ahead_max_m", "turned_max_rad")
"""Distance of the car from the plan that it drives, across and along the plan, and the error of its heading: absolute
values over the drive."""

KEYS = ("policy", "car", "setting", "episode")
ROWS = CsvKind(
    COMMAND,
    {
        "policy": str,
        "car": str,
        "episode": int,
        **{column.name: column.type_ for column in COLUMNS if column.name in OF_EPISODE},
        **dict.fromkeys(TRACKING, float),
        "new_start_count": int,
        "stop_count": int,
    },
    "%.4g",
)
"""policy: folder of the export; episode: number of the task in its setting; new_start_count: plans after the first that
began at the car and not at the plan before; stop_count: decisions in which the runtime stopped the vehicle."""


def rows_of(config: "RunConfig", driven: Driven, policy: str, car: str, numbers: Sequence[int]) -> pd.DataFrame:
    """Rows of encounters; numbers: of the tasks."""
    table = episodes(Drives.of(config, driven.trace), OF_EPISODE)
    table.insert(0, "policy", policy)
    table.insert(1, "car", car)
    table.insert(3, "episode", list(numbers))
    n_samples = round(config.scenario.dt_s / config.vehicle.control_s) * driven.trace.n_steps
    errors = [_errors(tracked(vehicle.car.samples[:n])) for vehicle, n in zip(driven.vehicles, n_samples, strict=True)]
    table[list(TRACKING)] = np.array(errors)
    said = [vehicle.said[:n] for vehicle, n in zip(driven.vehicles, driven.trace.n_steps, strict=True)]
    table["new_start_count"] = [sum(one.start == "measured" for one in each[1:]) for each in said]
    table["stop_count"] = [sum(bool(one.stop) for one in each) for each in said]
    return table


def _errors(samples: np.ndarray) -> list[float]:
    """Values of `TRACKING`; samples: [T, 3]."""
    ahead, left, turned = np.abs(samples).T
    each = [[np.sqrt((error**2).mean()), np.percentile(error, 95), error.max()] for error in (left, ahead)]
    return [*each[0], *each[1], turned.max()]


def read_rows(path: Path) -> pd.DataFrame:
    """The table as it is, without rows where there is none yet."""
    return read_csv(path, ROWS, KEYS) if path.is_file() else pd.DataFrame(columns=[*KEYS])


def add_rows(path: Path, table: pd.DataFrame) -> None:
    """Add rows, in the places of older ones of the same encounters; several processes may do so."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{path}.lock"):
        before = read_rows(path)
        together = table if before.empty else pd.concat([before, table])
        together = together.drop_duplicates([*KEYS], keep="last").sort_values([*KEYS])
        write_csv(path, together, ROWS)


def missing(table: pd.DataFrame, policy: str, car: str, setting: str, n_tasks: int) -> list[int]:
    """Numbers of the tasks that have not been driven."""
    is_own = (table["policy"] == policy) & (table["car"] == car) & (table["setting"] == setting)
    return sorted(set(range(n_tasks)) - set(table["episode"][is_own].tolist()))
