"""Made-up numbers of metrics.json."""

from typing import Any

FIXED_S = {"fixed_0": 0.0, "fixed_2": 2.0, "fixed_4": 4.0, "fixed_6": 6.0}
"""The paper's planners with one horizon."""


def measures(success: float, collision: float, time_s: float | None, n: int = 100) -> dict[str, Any]:
    """Measures of a planner in a setting, with rough intervals that get narrower with n."""
    half = 1 / n**0.5
    return {
        "success_rate": success,
        "success_low": max(success - half, 0.0),
        "success_high": min(success + half, 1.0),
        "collision_rate": collision,
        "collision_low": max(collision - half, 0.0),
        "collision_high": min(collision + half, 1.0),
        "timeout_rate": 1 - success - collision,
        "deadlock_rate": 0.0,
        "social_collision_rate": 0.0,
        "arrival_rate": success,
        "ego_first_rate": 0.5,
        "driving_time_s": time_s,
        "social_time_s": 12.5,
        "suspend_count": 1.0,
        "suspend_time_s": 2.0,
        "full_braking_count": 0.25,
        "reward": 10 * success - 5,
        "n_episodes": n,
        "smallest_gap_m": 0.7,
        "smallest_ttc_s": None,
        "largest_decel_mps2": 3.0,
        "largest_jerk_mps3": 20.0,
        "avoidable_rate": 0.0,
    }


def versus(success: float, half: float = 0.05, time_s: float | None = None) -> dict[str, Any]:
    """Differences of a planner to the policy."""

    def difference(value: float | None, half: float) -> dict[str, Any]:
        if value is None:
            return {"value": None, "low": None, "high": None, "n_tasks": 0}
        return {"value": value, "low": value - half, "high": value + half, "n_tasks": 100}

    return {
        "success": difference(success, half),
        "driving_time_s": difference(time_s, 0.1),
        "reward": difference(10 * success, 1.0),
    }
