"""The folder of encounters: a file per encounter, and their rows of episodes.csv."""

from collections import Counter
from pathlib import Path
from typing import Any

import pandas as pd
from filelock import FileLock

from negopipe.config.root import RunConfig
from negopipe.evaluation.encounter import encounter_text
from negopipe.evaluation.episodes_file import EPISODES, EPISODES_NAME, Drives, episodes
from negopipe.play.live import LiveEncounter
from negopipe.tracking.csv_file import read_csv, write_csv
from negopipe.tracking.whole_file import write_whole

FOLDER = "play"
"""Name of the folder in `outputs`."""
ENCOUNTERS = "encounters"
"""Name of its folder with the files of the encounters."""


class EncounterFolder:
    """Encounters that are over. Several servers may write to one folder."""

    def __init__(self, outputs: Path) -> None:
        self.folder = outputs / FOLDER
        self.table_path = self.folder / EPISODES_NAME

    def add(self, live: LiveEncounter) -> tuple[Path, pd.DataFrame]:
        """Write an encounter that is over; returns its file and its row of episodes.csv."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(self.folder / "lock"):
            before = self.table()
            number = 1 if before is None else int(before["episode"].max()) + 1
            encounter = live.encounter(number)
            row = rows(live.arena.config, encounter.drive, number)
            path = self.folder / ENCOUNTERS / f"{number:05}_{encounter.opponent}_{encounter.street}.json"
            path.parent.mkdir(exist_ok=True)
            write_whole(path, encounter_text(encounter).encode())
            write_csv(self.table_path, row if before is None else pd.concat([before, row]), EPISODES)
        return path, row

    def table(self) -> pd.DataFrame | None:
        """episodes.csv of the folder; None where there is none yet."""
        return read_csv(self.table_path, EPISODES, ("episode",)) if self.table_path.is_file() else None

    def results(self) -> list[dict[str, Any]]:
        """Results so far by opponent: encounters, their outcomes, who passed first, mean time of the person in s."""
        table = self.table()
        if table is None:
            return []
        return [_summary(str(name), own) for name, own in table.groupby("planner", sort=False)]


def rows(config: RunConfig, drive: Any, number: int) -> pd.DataFrame:
    """Rows of episodes.csv of the trace of an encounter."""
    return episodes(Drives.of(config, drive)).assign(episode=number)


def _summary(opponent: str, own: pd.DataFrame) -> dict[str, Any]:
    outcomes, first = Counter(own["outcome"]), Counter(own["passes_first"])
    time_s = own["social_time_s"].mean()
    return {
        "opponent": opponent,
        "n": len(own),
        **{name: outcomes[name] for name in ("success", "collision", "deadlock", "timeout", "social_collision")},
        "person_first": first["social"],
        "opponent_first": first["ego"],
        "mean_time_s": None if pd.isna(time_s) else round(float(time_s), 1),
    }
