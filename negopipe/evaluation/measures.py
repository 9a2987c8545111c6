"""The measures of a planner in a setting: each is one entry of `MEASURES`.

metrics.json, the report's tables, the table on the terminal, the charts in MLflow and the paired differences follow
from the entries. A *setting* is an evaluated distribution of tasks (`negopipe.evaluation.trace`).

Adding a measure: an entry in `MEASURES`. A quantity that episodes.csv lacks also needs a column with its function in
`negopipe.evaluation.episodes_file.COLUMNS`.
"""

from typing import Any

import pandas as pd

from negopipe.evaluation.measure import (
    Measure,
    indicator,
    itself,
    known,
    share,
    share_above,
    share_with_interval,
)
from negopipe.evaluation.statistics import Estimate
from negopipe.simulation.state import AT_REST_MPS

MEASURES = (
    Measure(
        "success_rate",
        "success",
        "%",
        "share of the episodes in which all vehicles reach their targets without a collision",
        column="outcome",
        aggregate=share_with_interval("success"),
        better="higher",
        table="outcomes",
        is_charted=True,
        compared=indicator("success"),
    ),
    Measure(
        "collision_rate",
        "collision",
        "%",
        "share of the episodes that end in a collision of the ego",
        column="outcome",
        aggregate=share_with_interval("collision"),
        better="lower",
        table="outcomes",
        is_charted=True,
    ),
    Measure(
        "timeout_rate",
        "timeout",
        "%",
        "share of the episodes that reach the time limit, deadlocks included",
        column="outcome",
        aggregate=share("deadlock", "timeout"),
        table="outcomes",
        is_charted=True,
    ),
    Measure(
        "deadlock_rate",
        "deadlock",
        "%",
        "share of the episodes that reach the time limit with the vehicles at rest nose to nose",
        column="outcome",
        aggregate=share("deadlock"),
        table="outcomes",
    ),
    Measure(
        "social_collision_rate",
        "social collision",
        "%",
        "share of the episodes that end in a collision among social vehicles only",
        column="outcome",
        aggregate=share("social_collision"),
        table="outcomes",
        is_rare=True,
    ),
    Measure(
        "arrival_rate",
        "arrivals",
        "%",
        "share of the episodes in which the ego reaches its target",
        column="driving_time_s",
        aggregate=known,
    ),
    Measure(
        "driving_time_s",
        "driving time",
        "s",
        "mean time until the ego reaches its target, over its arrivals",
        column="driving_time_s",
        decimals=2,
        table="driving",
        is_charted=True,
        compared=itself,
    ),
    Measure(
        "social_time_s",
        "social driving time",
        "s",
        "mean time until the nearest social vehicle reaches its target, over its arrivals",
        column="social_time_s",
        decimals=2,
        table="driving",
    ),
    Measure(
        "suspend_count",
        "suspensions",
        "count",
        "mean number of stops of the ego before it arrives",
        column="suspend_count",
        decimals=2,
        table="driving",
    ),
    Measure(
        "suspend_time_s",
        "suspension time",
        "s",
        "mean time of the ego at rest in these stops",
        column="suspend_time_s",
        decimals=2,
        table="driving",
    ),
    Measure(
        "ego_first_rate",
        "passes first",
        "%",
        "share of the episodes in which the ego leaves the corridor first",
        column="passes_first",
        aggregate=share("ego"),
        table="driving",
    ),
    Measure(
        "reward",
        "reward",
        "",
        "mean undiscounted sum of Eq. 3",
        column="reward",
        decimals=2,
        better="higher",
        table="outcomes",
        is_charted=True,
        compared=itself,
    ),
    Measure(
        "smallest_gap_m",
        "gap",
        "m",
        "mean smallest distance of the ego's footprint to a social vehicle's",
        column="smallest_gap_m",
        decimals=2,
        table="safety",
    ),
    Measure(
        "smallest_ttc_s",
        "TTC",
        "s",
        "mean smallest time to collision, over the episodes with a collision course",
        column="smallest_ttc_s",
        table="safety",
    ),
    Measure(
        "largest_decel_mps2",
        "deceleration",
        "m/s²",
        "mean largest deceleration of the ego",
        column="largest_decel_mps2",
        table="safety",
    ),
    Measure(
        "largest_jerk_mps3",
        "jerk",
        "m/s³",
        "mean largest absolute jerk of the ego",
        column="largest_jerk_mps3",
        table="safety",
    ),
    Measure(
        "full_braking_count",
        "full braking",
        "count",
        "mean number of decisions without a feasible plan, in which the ego brakes fully",
        column="full_braking_count",
        table="safety",
    ),
    Measure(
        "intervention_count",
        "interventions",
        "count",
        "mean number of decisions in which the safety layer replaced the plan of the ego",
        column="intervention_count",
        decimals=2,
        table="safety",
        is_rare=True,
    ),
    Measure(
        "moving_collision_rate",
        "collisions while moving",
        "%",
        "share of the episodes that end in a collision of the ego while it moves",
        column="contact_speed_mps",
        aggregate=share_above(AT_REST_MPS),
    ),
    Measure(
        "avoidable_rate",
        "avoidable collisions",
        "%",
        "share of the episodes that end in a collision which the ego could have avoided by braking",
        column="avoidable_by",
        aggregate=share("ego", "both"),
        table="safety",
    ),
    Measure(
        "avoidable_by_ego_rate",
        "avoidable by the ego alone",
        "%",
        "share of the episodes that end in a collision which only the ego could have avoided by braking",
        column="avoidable_by",
        aggregate=share("ego"),
    ),
    Measure(
        "avoidable_by_social_rate",
        "avoidable by the social vehicle alone",
        "%",
        "share of the episodes that end in a collision which only the social vehicle could have avoided by braking",
        column="avoidable_by",
        aggregate=share("social"),
    ),
    Measure(
        "avoidable_by_both_rate",
        "avoidable by either",
        "%",
        "share of the episodes that end in a collision which either vehicle could have avoided by braking",
        column="avoidable_by",
        aggregate=share("both"),
    ),
)
"""In reading order, which is the order of columns in tables."""


BY_DRIVER = "social_driver"
"""Column of episodes.csv by which the measures are split."""


def summary(table: pd.DataFrame) -> dict[str, Any]:
    """`evaluation.<setting>.<planner>.<measure>` as nested dicts of plain numbers, from rows of episodes.csv.

    Beside the measures stand `n_episodes` and, for a share with an interval, `<stem>_low` and `<stem>_high`. A measure
    is None where no episode has a value. Measures of columns that the table lacks are left out. Where several drivers
    drive the nearest social vehicle, `by_driver.<driver>` has the same for the episodes of each.
    """
    evaluation: dict[str, dict[str, Any]] = {}
    has_drivers = BY_DRIVER in table and table[BY_DRIVER].nunique() > 1
    for (setting, planner), rows in table.groupby(["setting", "planner"], sort=False):
        values = evaluation.setdefault(str(setting), {})[str(planner)] = _of_planner(rows)
        if has_drivers:
            values["by_driver"] = {str(name): _of_planner(part) for name, part in rows.groupby(BY_DRIVER)}
    return {"evaluation": evaluation}


def _of_planner(rows: pd.DataFrame) -> dict[str, Any]:
    values: dict[str, Any] = {"n_episodes": len(rows)}
    for measure in (measure for measure in MEASURES if measure.column in rows):
        found = measure.aggregate(rows[measure.column])
        if isinstance(found, Estimate):
            values |= dict(zip((measure.name, *measure.bounds), (found.value, found.low, found.high), strict=True))
        else:
            values[measure.name] = found
    return values
