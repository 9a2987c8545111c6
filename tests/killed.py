"""Trainings that are killed and go on."""

from pathlib import Path

import pandas as pd
import pytest
from composed import compose_config
from tracked import RecordedRun

from negopipe.stages import train

SMALL = (
    "+experiment=smoke",
    "device=cpu",
    "tracking.snapshot_period_s=1e-6",
    "scenario.episode_steps=20",  # so that episodes are cut off and start anew
)
DURATIONS = ["wall_s", "decisions_per_s"]


class Killed(BaseException):
    """Stands for SIGKILL: nobody handles it."""


class MortalRun(RecordedRun):
    """Dies in its `n`th iteration, after the update and before anything is kept of it."""

    def __init__(self, folder: Path, n: int) -> None:
        super().__init__(folder)
        self.n_left = n

    def log_metrics(self, metrics: dict[str, float], step: int) -> None:
        self.n_left -= 1
        if self.n_left == 0:
            raise Killed


def result(folder: Path) -> tuple[bytes, pd.DataFrame]:
    history = pd.read_csv(folder / "history.csv")
    return (folder / "checkpoint.safetensors").read_bytes(), history.drop(columns=DURATIONS)


def drive(folder: Path, *overrides: str, deaths: tuple[int, ...] = ()) -> tuple[bytes, pd.DataFrame]:
    """Train, killed in the iterations `deaths` of the processes before the last."""
    config = compose_config([*SMALL, *overrides])
    folder.mkdir(exist_ok=True)
    for n in deaths:
        with pytest.raises(Killed):
            train.run(config, MortalRun(folder, n))  # type: ignore[arg-type]
    train.run(config, RecordedRun(folder))  # type: ignore[arg-type]
    return result(folder)
