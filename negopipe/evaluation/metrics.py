"""What is measured on evaluated episodes: one table row each, the summary of a table, and Eq. 7.

The terms are those of docs/reading.md, "suspend number", "driving time", "deadlock" and "psi (Eq. 7)".
"""

from typing import Any

import numpy as np
import pandas as pd

from negopipe.evaluation.horizon_text import to_text
from negopipe.evaluation.statistics import rate
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.simulation.state import AT_REST_MPS, EGO, NEAREST

MOVING_MPS = 0.5
"""Above this speed a vehicle moves; in between it keeps what it was."""
MEANS = ("suspend_count", "suspend_time_s", "full_braking_count", "reward")
"""Columns of `episodes` whose means over all episodes are told."""
SAFETY = ("smallest_gap_m", "smallest_ttc_s", "largest_decel_mps2", "largest_jerk_mps3")
"""Columns of `negopipe.evaluation.safety` whose means are told."""


def episodes(trace: Trace, corridor_length_m: float) -> pd.DataFrame:
    """One row per episode.

    planner, setting (the family's name), episode (index into the trace)
    ego_start_distance_m, social_start_distance_m, style_horizon_s: of the ego and the nearest social vehicle
    outcome: success (all reached their targets, no collision) | collision | deadlock | timeout | social_collision
    n_decisions: until the episode ended
    ego_time_s, social_time_s: until the vehicle reached its target; NaN if it did not
    driving_time_s: the ego's time again, under the name of the paper's figure
    suspend_count, suspend_time_s: how often and how long the ego stood before it reached its target
    reward: sum of Eq. 3, undiscounted
    full_braking_count: decisions of the ego in which no feasible plan existed
    mean_horizon_s: mean prediction horizon of the ego; NaN for a driver without one
    passes_first: ego | social | none, whose centre left the corridor first
    horizons: the ego's, decision by decision, as `negopipe.evaluation.horizon_text` writes them
    """
    suspend_count, suspend_time_s = suspensions(trace)
    time_s = np.where(trace.reached_step >= 0, trace.reached_step * trace.dt_s, np.nan)
    is_running = running(trace)
    return pd.DataFrame(
        {
            "planner": trace.planner,
            "setting": trace.setting,
            "episode": np.arange(len(trace.n_steps)),
            "ego_start_distance_m": trace.start_distance_m[:, EGO],
            "social_start_distance_m": trace.start_distance_m[:, NEAREST],
            "style_horizon_s": trace.style_horizon_s[:, NEAREST],
            "outcome": np.array(OUTCOMES)[trace.outcome],
            "n_decisions": trace.n_steps,
            "ego_time_s": time_s[:, EGO],
            "social_time_s": time_s[:, NEAREST],
            "driving_time_s": time_s[:, EGO],
            "suspend_count": suspend_count,
            "suspend_time_s": suspend_time_s,
            "reward": (trace.reward * is_running).sum(0, dtype=np.float64),
            "full_braking_count": (trace.is_full_braking[:, :, EGO] & is_running).sum(0),
            "mean_horizon_s": _mean_over(trace.horizon_s[:, :, EGO], is_running),
            "passes_first": passes_first(trace, corridor_length_m),
            "horizons": to_text(trace.horizon_s[:, :, EGO], trace.n_steps),
        }
    )


def running(trace: Trace) -> np.ndarray:
    """[T, E] bool: the decision was taken before the episode's end."""
    return np.arange(trace.reward.shape[0])[:, None] < trace.n_steps


def suspensions(trace: Trace) -> tuple[np.ndarray, np.ndarray]:
    """Times the ego comes to rest after having moved, before it reaches its target, and time at rest.

    Returns the count [E] int64 and the time [E] float64, s. The state after a decision stands for that
    decision's dt.
    """
    speed = trace.speed_mps[:, :, EGO]
    reached = trace.reached_step[:, EGO]
    last_step = np.where(reached >= 0, np.minimum(reached, trace.n_steps), trace.n_steps)
    has_moved = speed[0] > MOVING_MPS
    is_moving = has_moved.copy()
    count = np.zeros(len(last_step), dtype=np.int64)
    n_rest = np.zeros(len(last_step), dtype=np.int64)
    for step in range(1, len(speed)):
        is_rest = (speed[step] < AT_REST_MPS) & has_moved & (step <= last_step)
        count += is_rest & is_moving
        n_rest += is_rest
        has_moved |= speed[step] > MOVING_MPS
        is_moving = np.where(is_rest, False, is_moving | (speed[step] > MOVING_MPS))
    return count, n_rest * trace.dt_s


def passes_first(trace: Trace, corridor_length_m: float) -> np.ndarray:
    """[E] str, ego | social | none: whose centre was the first to leave the corridor at its far end."""
    is_through = trace.progress_m > corridor_length_m
    never = len(is_through)
    step = np.where(is_through.any(0), is_through.argmax(0), never)
    ego, social = step[:, EGO], step[:, EGO + 1 :].min(1)
    return np.select([ego < social, social < never], ["ego", "social"], default="none")


def behaviour_index(trace: Trace) -> np.ndarray:
    """psi of Eq. 7, [T+1, E] float64, rad: positive = prosocial, negative = competitive, NaN after the end.

    psi = atan((s_soc - s_ego) / (d_ini_ego / d_ini_soc)) with the distances s travelled since the start, from
    when the social vehicle is perceived; of several social vehicles the one that starts nearest counts.
    """
    travelled = (trace.progress_m - trace.progress_m[0]).astype(np.float64)
    ratio = trace.start_distance_m[:, EGO] / trace.start_distance_m[:, NEAREST]
    psi = np.arctan((travelled[:, :, NEAREST] - travelled[:, :, EGO]) / ratio)
    return np.where(np.arange(len(psi))[:, None] <= trace.n_steps, psi, np.nan)


def summary(table: pd.DataFrame) -> dict[str, Any]:
    """`evaluation.<setting>.<planner>.<measure>` as nested dicts of plain numbers, from rows of `episodes`.

    success_rate, collision_rate (of the ego), social_collision_rate (of social vehicles only), deadlock_rate,
    timeout_rate (deadlocks included), arrival_rate (the ego reached its target), ego_first_rate (the ego passed first):
    shares of the episodes; of the first two also the bounds of the Wilson interval, success_low, success_high and so
    on. driving_time_s of the ego, social_time_s: means over arrivals, None if there are none. suspend_count,
    suspend_time_s, full_braking_count, reward: means over all episodes.
    n_episodes. Of tables with the columns of `negopipe.evaluation.safety` also smallest_gap_m, smallest_ttc_s,
    largest_decel_mps2 and largest_jerk_mps3, means over the episodes that have one; and of all episodes the shares that
    end in a collision which the ego could have avoided (avoidable_rate), by who could: avoidable_by_ego_rate (alone),
    avoidable_by_social_rate (alone), avoidable_by_both_rate.
    """
    evaluation: dict[str, dict[str, Any]] = {}
    for (setting, planner), rows in table.groupby(["setting", "planner"], sort=False):
        evaluation.setdefault(str(setting), {})[str(planner)] = _measures(rows)
    return {"evaluation": evaluation}


def _measures(rows: pd.DataFrame) -> dict[str, float | int | None]:
    ended = {outcome: rate((rows["outcome"] == outcome).to_numpy()) for outcome in OUTCOMES}
    share = {outcome: estimate.value for outcome, estimate in ended.items()}
    return {
        "success_rate": share["success"],
        "success_low": ended["success"].low,
        "success_high": ended["success"].high,
        "collision_rate": share["collision"],
        "collision_low": ended["collision"].low,
        "collision_high": ended["collision"].high,
        "timeout_rate": share["deadlock"] + share["timeout"],
        "deadlock_rate": share["deadlock"],
        "social_collision_rate": share["social_collision"],
        "arrival_rate": float(rows["driving_time_s"].notna().mean()),
        "ego_first_rate": float((rows["passes_first"] == "ego").mean()),
        **{name: _mean(rows[name]) for name in ("driving_time_s", "social_time_s")},
        **{name: float(rows[name].mean()) for name in MEANS},
        "n_episodes": len(rows),
        **(_safety_measures(rows) if "avoidable_by" in rows else {}),
    }


def _safety_measures(rows: pd.DataFrame) -> dict[str, float | None]:
    share = {who: float((rows["avoidable_by"] == who).mean()) for who in ("ego", "social", "both")}
    by_whom = {f"avoidable_by_{who}_rate": value for who, value in share.items()}
    measured = {name: _mean(rows[name]) for name in SAFETY}
    return {**measured, "avoidable_rate": share["ego"] + share["both"], **by_whom}


def _mean(values: pd.Series) -> float | None:
    known = values.dropna()
    return float(known.mean()) if len(known) else None


def _mean_over(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Mean of [T, E] values where the mask holds; NaN where it never does or a value is NaN."""
    total = np.where(mask, values, 0.0).sum(0, dtype=np.float64)
    n = mask.sum(0)
    return np.divide(total, n, out=np.full(len(n), np.nan), where=n > 0)
