"""The sequences of an oracle.csv, driven as the planner `oracle` beside the other planners."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from negopipe.errors import UserError
from negopipe.evaluation.horizon_text import from_text
from negopipe.evaluation.replay import replay
from negopipe.evaluation.trace import ORACLE, Trace
from negopipe.game.game import Game
from negopipe.simulation.state import EGO, NEAREST, Task
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.csv_file import CsvKind, read_csv
from negopipe.tracking.pretrained import find_oracle

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

SAME_RETURN = 1e-3
"""Largest difference of returns of the same drive; one step costs more."""
SAME_START_M = 1e-3
DOES_NOT_FIT = "the table that comes with negopipe is for another road, planner, reward or other tasks"
"""Log line where such a table is left out."""
START = ("ego_start_distance_m", "social_start_distance_m", "style_horizon_s")
COLUMNS = ("setting", "episode", "horizons", "reward", *START)
"""Columns that driving needs."""
ORACLE_TABLE = CsvKind(
    "the stage `oracle`",
    {
        "setting": str,
        "episode": int,
        **dict.fromkeys(START, float),
        "outcome": str,
        "reward": float,
        "ego_time_s": float,
        "social_time_s": float,
        "horizons": str,
        "best_fixed_horizon_s": float,
        "best_fixed_reward": float,
        "fixed_*_outcome": str,
        "fixed_*_reward": float,
        "n_switches": int,
    },
)
"""oracle.csv: a row per task, `stages.oracle.table` with the number of switches."""


@dataclass(frozen=True)
class OracleTable:
    """rows: rows of an oracle.csv with horizons; comes_along: the table is the one that comes with negopipe"""

    rows: pd.DataFrame
    comes_along: bool

    def has(self, setting: str) -> bool:
        return bool((self.rows["setting"] == setting).any())


def read_oracle(reference: str) -> OracleTable:
    """The table that `evaluation.oracle` names; UserError if there is none, or one without horizons."""
    path = find_oracle(reference)
    if not path.is_file():
        raise UserError(
            f"evaluation.oracle must be pretrained or an oracle.csv as +experiment=oracle writes it, got {path}: "
            "no such file"
        )
    try:
        table = read_csv(path, ORACLE_TABLE, COLUMNS)
    except UserError as error:
        raise UserError(f"evaluation.oracle must be an oracle.csv with horizons: {error}") from error
    if (table["horizons"] == "").all():
        raise UserError(f"evaluation.oracle must be an oracle.csv with horizons, got {path}: its column is empty")
    return OracleTable(table[table["horizons"] != ""], comes_along=path != Path(reference))


def drive_oracle(config: "RunConfig", game: Game, tasks: Task, oracle: OracleTable, setting: str) -> Trace | None:
    """The record of the table's sequences on the first tasks of a setting; their returns must equal the table's.

    The table that comes with negopipe is cut to the number of tasks, and None is returned if it is of other tasks. Any
    other table is named by the user: UserError if it is of other tasks.
    """
    found = oracle.rows[oracle.rows["setting"] == setting]
    if oracle.comes_along:
        found = found.head(len(tasks))
    elif found["episode"].tolist() != list(range(len(found))) or len(found) > len(tasks):
        said = f"{len(found)} tasks up to {found['episode'].max()}"
        raise UserError(f"evaluation.oracle must be of the first of the {len(tasks)} tasks of {setting}, got {said}")
    sequences, longest = list(map(from_text, found["horizons"])), game.simulator.scenario.episode_steps
    got = "longer episodes"
    if max(map(len, sequences)) <= longest and (_is_of(found, tasks) or not oracle.comes_along):
        driven = map_tensors(lambda field: field[: len(found)], tasks)
        trace = replay(game, driven, sequences, config.evaluation.reward, (ORACLE, setting))
        returned = trace.reward.sum(0, dtype="float64")
        if (abs(returned - found["reward"].to_numpy()) < SAME_RETURN).all():
            return trace
        got = f"{returned.mean():.2f}"
    if oracle.comes_along:
        return None
    expected = f"{found['reward'].mean():.2f} on average in {setting}, as it says, got {got}"
    raise UserError(f"evaluation.oracle must be of this road, planner and reward and return {expected}")


def _is_of(found: pd.DataFrame, tasks: Task) -> bool:
    """The rows have the starts and styles of the first tasks."""
    drawn = (tasks.start_distance[:, EGO], tasks.start_distance[:, NEAREST], tasks.style_horizon[:, NEAREST])
    return all(
        np.allclose(
            found[column].to_numpy(float),
            values[: len(found)].cpu().numpy(),
            rtol=0.0,
            atol=SAME_START_M,
            equal_nan=True,
        )
        for column, values in zip(START, drawn, strict=True)
    )
