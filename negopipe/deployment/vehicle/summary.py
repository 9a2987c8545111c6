"""Rows of encounters as figures of a car in a setting."""

import numpy as np
import pandas as pd

from negopipe.evaluation.statistics import rate


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """A row per policy, car and setting; rates in %, with their Wilson intervals."""
    groups = rows.groupby(["policy", "car", "setting"], sort=True)
    return pd.DataFrame([{**dict(zip(groups.keys, key, strict=True)), **_figures(of)} for key, of in groups])


def _figures(rows: pd.DataFrame) -> dict[str, object]:
    outcome = rows["outcome"]
    weights = rows["n_decisions"]
    return {
        "tasks": len(rows),
        "success": _rate(outcome == "success"),
        "collisions": _rate(outcome == "collision"),
        "deadlocks": int((outcome == "deadlock").sum()),
        "time_s": round(float(rows["ego_time_s"].mean()), 1),
        "left_rms_m": round(float(np.sqrt(np.average(rows["left_rms_m"] ** 2, weights=weights))), 3),
        "left_p95_m": round(float(np.average(rows["left_p95_m"], weights=weights)), 2),
        "left_max_m": round(float(rows["left_max_m"].max()), 2),
        "ahead_rms_m": round(float(np.sqrt(np.average(rows["ahead_rms_m"] ** 2, weights=weights))), 3),
        "ahead_p95_m": round(float(np.average(rows["ahead_p95_m"], weights=weights)), 2),
        "ahead_max_m": round(float(rows["ahead_max_m"].max()), 2),
        "gap_m": round(float(rows["smallest_gap_m"].mean()), 2),
        "decel_mps2": round(float(rows["largest_decel_mps2"].mean()), 1),
        "jerk_mps3": round(float(rows["largest_jerk_mps3"].mean()), 1),
        "interventions": round(float(rows["intervention_count"].mean()), 2),
        "full_braking": round(float(rows["full_braking_count"].mean()), 2),
    }


def _rate(is_hit: pd.Series) -> str:
    found = rate(is_hit.to_numpy(dtype=bool))
    return f"{100 * found.value:.1f} [{100 * found.low:.1f}, {100 * found.high:.1f}]"
