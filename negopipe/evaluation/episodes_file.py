"""episodes.csv: a row per evaluated episode of every planner, as `metrics.episodes` and `safety.safety` measure it."""

from negopipe.tracking.csv_file import CsvKind

EPISODES_NAME = "episodes.csv"
EPISODES = CsvKind(
    "the stage `evaluate`",
    {
        "planner": str,
        "setting": str,
        "episode": int,
        "ego_start_distance_m": float,
        "social_start_distance_m": float,
        "style_horizon_s": float,
        "outcome": str,
        "n_decisions": int,
        "ego_time_s": float,
        "social_time_s": float,
        "driving_time_s": float,
        "suspend_count": int,
        "suspend_time_s": float,
        "reward": float,
        "full_braking_count": int,
        "mean_horizon_s": float,
        "passes_first": str,
        "horizons": str,
        "smallest_gap_m": float,
        "smallest_ttc_s": float,
        "largest_decel_mps2": float,
        "largest_jerk_mps3": float,
        "avoidable_by": str,
    },
)
