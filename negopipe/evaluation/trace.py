"""The record of evaluated episodes, from which every metric, figure and animation is computed.

A *setting* is an evaluated distribution of tasks, one of `evaluation.settings`. A *family* is a distribution of tasks
in the scenario or the curriculum; a setting has the name of the scenario's family that its tasks are drawn from.
"""

import zipfile
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from negopipe.checks import N_COPIES
from negopipe.errors import UserError

TRACES_NAME = "traces.npz"
"""File of the traces in a run folder."""
OUTCOMES = ("success", "collision", "deadlock", "timeout", "social_collision")
"""Names of `Trace.outcome`. A deadlock is a truncation with the vehicles at rest nose to nose, a timeout any other
truncation. A collision involves the ego. A social collision involves social vehicles only, whatever the ego did."""

ADAPTIVE = "adaptive"
"""`Trace.planner` of the planner whose prediction horizon the policy chooses."""

ORACLE = "oracle"
"""`Trace.planner` of the horizon sequences found by a search with full knowledge of the task."""


@dataclass(frozen=True)
class Trace:
    """One planner on the tasks of one setting: E episodes, at most T decisions, V vehicles (column 0 is the ego).

    Rows after an episode's end (index > n_steps) repeat its last state.

    planner: name, e.g. "adaptive", "fixed_2"
    setting: name of the evaluated setting, e.g. "push"
    dt_s: float, time between decisions
    street: [E] int64, number of the street
    corridor_m: [E] float32, m, length of its corridor
    start_distance_m: [E, V] float32, m, to the mouth that the vehicle meets first
    style_horizon_s: [E, V] float32, s, style at the start; NaN where a driver chooses its horizons
    length_m, width_m: [E, V] float32, m, of the footprint
    driver: [E, V] str, name of the vehicle's driver in the population; empty for the ego
    position_m: [T+1, E, V, 2] float32, world frame
    yaw_rad: [T+1, E, V] float32, world frame
    speed_mps: [T+1, E, V] float32
    progress_m: [T+1, E, V] float32, s along the vehicle's own route, 0 at the mouth
    horizon_s: [T, E, V] float32, prediction horizon used in the decision; NaN for drivers without one
    is_full_braking: [T, E, V] bool, no feasible plan existed
    intervention: [T, E] int8, index into `negopipe.safety.layer.INTERVENTIONS`, 0 = the ego drove by its plan
    reward: [T, E] float32, reward of Eq. 3 (docs/reading.md, "reward") per decision, 0 after the end
    n_steps: [E] int64, decisions until the episode ended
    reached_step: [E, V] int64, first step index at which the vehicle had reached its target, -1 = never
    outcome: [E] int64, index into OUTCOMES
    """

    planner: str
    setting: str
    dt_s: float
    street: np.ndarray
    corridor_m: np.ndarray
    start_distance_m: np.ndarray
    style_horizon_s: np.ndarray
    length_m: np.ndarray
    width_m: np.ndarray
    driver: np.ndarray
    position_m: np.ndarray
    yaw_rad: np.ndarray
    speed_mps: np.ndarray
    progress_m: np.ndarray
    horizon_s: np.ndarray
    is_full_braking: np.ndarray
    intervention: np.ndarray
    reward: np.ndarray
    n_steps: np.ndarray
    reached_step: np.ndarray
    outcome: np.ndarray

    def first(self, n: int) -> "Trace":
        """The first `n` episodes, or all if there are fewer."""
        cut = {
            name: getattr(self, name)[:n] if axis == 0 else getattr(self, name)[:, :n]
            for name, axis in EPISODE_AXIS.items()
        }
        return replace(self, **cut)


EPISODE_AXIS = {
    "street": 0, "corridor_m": 0, "start_distance_m": 0, "style_horizon_s": 0, "length_m": 0, "width_m": 0, "driver": 0,
    "n_steps": 0, "reached_step": 0, "outcome": 0,
    "position_m": 1, "yaw_rad": 1, "speed_mps": 1, "progress_m": 1,
    "horizon_s": 1, "is_full_braking": 1, "intervention": 1, "reward": 1,
}  # fmt: skip
"""Array of a `Trace` -> its axis of episodes."""


STEP_BYTES = 25
"""Of one vehicle's step: its fields of shape [T, E, V]."""


def trace_bytes(n_episodes: int, episode_steps: int, n_vehicles: int) -> int:
    """Bytes of a `Trace` while it is put together."""
    return n_episodes * episode_steps * n_vehicles * STEP_BYTES * N_COPIES


_FORMAT = "negopipe traces 5"
"""Written into every file; the number changes when a field of `Trace` changes."""


def save_traces(path: Path, traces: list[Trace]) -> None:
    """Write the traces as one compressed npz archive without pickle."""
    arrays: dict[str, np.ndarray] = {"format": np.array(_FORMAT), "n_traces": np.array(len(traces))}
    for i, trace in enumerate(traces):
        arrays |= {f"{i}.{field.name}": np.asarray(getattr(trace, field.name)) for field in fields(Trace)}
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)  # type: ignore[arg-type]


def load_traces(path: Path) -> list[Trace]:
    """The traces of `save_traces`, in the same order.

    Raises UserError if the file is missing, is no such archive or has another format number.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; the stage `evaluate` writes it")
    if not zipfile.is_zipfile(path):
        raise UserError(f"{path}: not a file of traces; it must be an npz archive written by `evaluate`")
    with np.load(path, allow_pickle=False) as archive:
        if "format" not in archive or str(archive["format"]) != _FORMAT:
            raise UserError(f"{path}: not a file of traces with the format {_FORMAT!r}; run the stage `evaluate` anew")
        return [_read_trace(archive, i) for i in range(int(archive["n_traces"]))]


def _read_trace(archive: np.lib.npyio.NpzFile, index: int) -> Trace:
    values: dict[str, Any] = {field.name: archive[f"{index}.{field.name}"] for field in fields(Trace)}
    values |= {name: values[name].item() for name in ("planner", "setting", "dt_s")}
    return Trace(**values)
