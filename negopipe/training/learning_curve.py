"""The learning curve: a row per iteration and a row per episode of a training."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from negopipe.learning.rollout import Rollout
from negopipe.tracking.csv_file import write_csv
from negopipe.tracking.run_folder import HISTORY_NAME, TRAINING_EPISODES_NAME
from negopipe.tracking.training_files import HISTORY, TRAINING_EPISODES

N_RECENT_EPISODES = 200
"""Number of latest episodes in the success rate, the collision rate and the mean return."""

MEANS_OF_EPISODES = {"success_rate": "is_success", "collision_rate": "is_collision", "return_mean": "return"}
"""Column of the episodes by the column of the learning curve that is its mean; NaN until an episode has ended."""


class LearningCurve:
    """History of a training.

    rows: one per iteration; success_rate, collision_rate and return_mean are those of the latest episodes
    episodes: name -> [N] float64 on the CPU, of all episodes so far: `decisions` of the training up to the end of the
        iteration in which the episode ended, the undiscounted `return`, 1 or 0 for `is_success` and `is_collision`,
        and the columns of `Rollout.final_info`
    """

    def __init__(self, n_decisions_per_iteration: int) -> None:
        self.rows: list[dict] = []
        self.n_per_iteration = n_decisions_per_iteration
        self.episodes: dict[str, Tensor] = {}
        self._started_s = self._last_s = time.monotonic()
        self._tracking_s = 0.0

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, stage: str, rollout: Rollout, metrics: dict[str, float]) -> dict:
        """Append an iteration; returns its row. Means over episodes are NaN until one has ended."""
        decisions = (len(self.rows) + 1) * self.n_per_iteration
        self._count_episodes(decisions, rollout)
        means = {key: float(self.episodes[name][-N_RECENT_EPISODES:].mean()) for key, name in MEANS_OF_EPISODES.items()}
        now_s = time.monotonic()
        row = {
            "decisions": decisions,
            "stage": stage,
            **means,
            **metrics,
            "decisions_per_s": self.n_per_iteration / (now_s - self._last_s),
            "wall_s": now_s - self._started_s,
        }
        self._last_s = now_s
        self.rows.append(row)
        return row

    def _count_episodes(self, decisions: int, rollout: Rollout) -> None:
        is_over = rollout.is_over
        ended = {
            "return": rollout.episode_return[is_over],
            "is_success": rollout.is_success[is_over],
            "is_collision": rollout.is_collision[is_over],
            **rollout.final_info,
        }
        ended = {"decisions": torch.full((int(is_over.sum()),), decisions), **ended}
        new = {name: values.to("cpu", torch.float64) for name, values in ended.items()}
        self.episodes = {name: torch.cat([self.episodes.get(name, values[:0]), values]) for name, values in new.items()}

    def state_dict(self) -> dict[str, Any]:
        """State without the episodes, as JSON values."""
        return {"rows": self.rows, **self._times()}

    def load_state_dict(self, state: dict[str, Any], episodes: Mapping[str, Tensor]) -> None:
        """Restore a state of `state_dict`; the time since then does not count."""
        self.rows, self.episodes = state["rows"], dict(episodes)
        self._last_s = time.monotonic()
        self._started_s = self._last_s - state["wall_s"]
        self._tracking_s = state["tracking_s"]

    @contextmanager
    def tracking(self) -> Iterator[None]:
        """Context whose duration counts as tracking, not as training."""
        started_s = time.monotonic()
        yield
        self._tracking_s += time.monotonic() - started_s

    def scalars(self, row: dict) -> dict[str, float]:
        """Metrics of a row by their names in the dashboard."""
        return {f"train/{k}": v for k, v in row.items() if isinstance(v, float) and v == v}

    def text(self, row: dict) -> str:
        """Text of the progress line after a row."""
        outcome = "no episode has ended"
        if row["success_rate"] == row["success_rate"]:
            outcome = f"success {row['success_rate']:4.0%} return {row['return_mean']:5.1f}"
        return f"{row['stage']} {outcome} {row['decisions_per_s']:5.0f} decisions/s"

    def summary(self) -> dict[str, float]:
        """The `train` part of metrics.json; tracking_share is the share of the time spent on store and snapshots."""
        decisions, times = self.rows[-1]["decisions"], self._times()
        return {
            "decisions": decisions,
            "wall_s": times["wall_s"],
            "decisions_per_s": decisions / times["wall_s"],
            "tracking_share": times["tracking_s"] / times["wall_s"],
        }

    def _times(self) -> dict[str, float]:
        return {"wall_s": time.monotonic() - self._started_s, "tracking_s": self._tracking_s}

    def write(self, folder: Path) -> None:
        """Write history.csv, a row per iteration, and training_episodes.csv, a row per episode."""
        write_csv(folder / HISTORY_NAME, pd.DataFrame(self.rows), HISTORY)
        table = pd.DataFrame({name: values.numpy() for name, values in self.episodes.items()})
        flags = {name: "int64" for name in ("decisions", "is_success", "is_collision")}
        write_csv(folder / TRAINING_EPISODES_NAME, table.astype(flags), TRAINING_EPISODES)
