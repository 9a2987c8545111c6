"""history.csv and training_episodes.csv of a run folder."""

from negopipe.tracking.csv_file import CsvKind

HISTORY = CsvKind("the stage `train`", {"decisions": int, "stage": str, "*": float})
"""history.csv: a row per iteration; its numbers include the measures of the algorithm's updates."""


TRAINING_EPISODES = CsvKind(
    "the stage `train`", {"decisions": int, "is_success": int, "is_collision": int, "*": float}, float_format="%.6g"
)
"""training_episodes.csv: a row per episode, the columns of `LearningCurve.episodes`."""
