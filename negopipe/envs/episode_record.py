"""The record of running episodes, from which their metrics and pictures are made."""

from typing import Any, NamedTuple

import numpy as np
import torch

from negopipe.evaluation.episodes import stands_nose_to_nose
from negopipe.evaluation.episodes_file import COLUMNS, Drives
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.game.game import Game
from negopipe.report.street_view import Moment
from negopipe.simulation.simulator import Events
from negopipe.simulation.state import EGO, Motion, World
from negopipe.tensors.tree import map_tensors

METRICS = (
    *("outcome", "n_decisions", "driving_time_s", "social_time_s", "suspend_count", "suspend_time_s"),
    *("full_braking_count", "mean_horizon_s", "passes_first", "smallest_gap_m"),
)
"""Columns of episodes.csv that `info` holds at the end of an episode."""


TASK_FIELDS = {
    "start_distance_m": "start_distance",
    "style_horizon_s": "style_horizon",
    "length_m": "length",
    "width_m": "width",
}
"""Fields of `Trace` that are fields of `Task`."""


class Shot(NamedTuple):
    """A moment with what stays the same in its episode.

    street: number
    reach_m: distance of the outermost start from the corridor's middle
    size_m: [V, 2] length and width
    """

    street: int
    reach_m: float
    size_m: np.ndarray
    moment: Moment


class EpisodeRecord:
    """The states and decisions of the running episodes of E worlds, as arrays like those of `Trace`.

    n_decisions: [E] int64, decisions taken in each
    """

    def __init__(self, game: Game, n_worlds: int) -> None:
        scenario = game.simulator.scenario
        n_steps, n_vehicles, self.dt_s = scenario.episode_steps, scenario.n_vehicles, scenario.dt_s
        per_vehicle = (n_worlds, n_vehicles)
        floats = {"yaw_rad": (), "speed_mps": (), "progress_m": (), "position_m": (2,)}
        self._states = {name: np.zeros((n_steps + 1, *per_vehicle, *axes), np.float32) for name, axes in floats.items()}
        self._decisions = {
            "horizon_s": np.zeros((n_steps, *per_vehicle), np.float32),
            "is_full_braking": np.zeros((n_steps, *per_vehicle), bool),
            "intervention": np.zeros((n_steps, n_worlds), np.int8),
            "reward": np.zeros((n_steps, n_worlds), np.float32),
        }
        self._tasks: dict[str, np.ndarray] = {
            "street": np.zeros(n_worlds, np.int64),
            "corridor_m": np.zeros(n_worlds, np.float32),
            **{name: np.zeros(per_vehicle, np.float32) for name in TASK_FIELDS},
            "driver": np.full(per_vehicle, "", object),
            "reached_step": np.zeros(per_vehicle, np.int64),
        }
        self.n_decisions = np.zeros(n_worlds, np.int64)

    def start(self, game: Game, world: World, which: np.ndarray) -> None:
        """Forget the episodes of the worlds `which` [n], which are at the start of others."""
        task = world.task
        way = task.direction[:, EGO]
        rows = {"street": way.abs().long(), "corridor_m": torch.ones_like(way) * game.simulator.road.corridor_m(way)}
        rows |= {name: getattr(task, field) for name, field in TASK_FIELDS.items()}
        for name, values in rows.items():
            self._tasks[name][which] = values.numpy()[which]
        self._tasks["driver"][which] = game.cast.named(task.casting.driver)[which]
        self._tasks["reached_step"][which] = -1
        self.n_decisions[which] = 0
        self._write_state(game, world, which)

    def add(self, game: Game, moved: World, motion: Motion, of_egos: dict[str, np.ndarray]) -> None:
        """Append a decision of every world, by which it has reached `moved`; of_egos: intervention and reward, [E]."""
        worlds = np.arange(len(self.n_decisions))
        rows = {"horizon_s": motion.horizon.numpy(), "is_full_braking": motion.is_full_braking.numpy()}
        for name, values in (rows | of_egos).items():
            self._decisions[name][self.n_decisions, worlds] = values
        self.n_decisions += 1
        reached = self._tasks["reached_step"]
        is_new = moved.has_reached.numpy() & (reached < 0)
        self._tasks["reached_step"] = np.where(is_new, self.n_decisions[:, None], reached)
        self._write_state(game, moved, worlds)

    def _write_state(self, game: Game, world: World, which: np.ndarray) -> None:
        vehicles = world.vehicles
        progress = game.simulator.road.progress(vehicles.position, world.task.direction)
        rows = {"position_m": vehicles.position, "yaw_rad": vehicles.yaw, "speed_mps": vehicles.speed}
        for name, values in (rows | {"progress_m": progress}).items():
            self._states[name][self.n_decisions[which], which] = values.numpy()[which]

    def shot(self, world: int, outcome: str | None = None) -> Shot:
        """The latest moment of a world; outcome: of its episode, if that is over."""
        n, tasks = self.n_decisions[world], {name: values[world] for name, values in self._tasks.items()}
        position, yaw, speed = (self._states[name][n, world].copy() for name in ("position_m", "yaw_rad", "speed_mps"))
        has_plan = n > 0 and outcome is None
        horizon_s = float(self._decisions["horizon_s"][n - 1, world, EGO]) if has_plan else np.nan
        intervention = int(self._decisions["intervention"][n - 1, world]) if has_plan else 0
        reach_m = float(tasks["start_distance_m"].max() + tasks["corridor_m"] / 2)
        moment = Moment(float(n * self.dt_s), position, yaw, speed, horizon_s, intervention, outcome)
        return Shot(int(tasks["street"]), reach_m, np.stack([tasks["length_m"], tasks["width_m"]], -1), moment)

    def trace(self, world: int, outcome: str) -> Trace:
        """The episode of one world, which is over."""
        n, here = int(self.n_decisions[world]), slice(world, world + 1)
        return Trace(
            planner="agent",
            setting="environment",
            dt_s=self.dt_s,
            n_steps=self.n_decisions[here].copy(),
            outcome=np.array([OUTCOMES.index(outcome)]),
            **{name: values[here].copy() for name, values in self._tasks.items()},
            **{name: values[: n + 1, here].copy() for name, values in self._states.items()},
            **{name: values[:n, here].copy() for name, values in self._decisions.items()},
        )

    def outcome(self, game: Game, moved: World, events: Events, world: int) -> str:
        """Outcome of the episode of a world that is over, one of `OUTCOMES`; moved: state of all worlds at its end."""
        if bool(moved.has_collided[world, EGO + 1 :].any()) and not bool(events.is_collision[world]):
            return "social_collision"
        if bool(events.is_terminated[world]):
            return "success" if bool(events.is_success[world]) else "collision"
        return "deadlock" if self._stands_nose_to_nose(game, moved, world) else "timeout"

    def _stands_nose_to_nose(self, game: Game, moved: World, world: int) -> bool:
        """Whether the episode of a world ends in a deadlock."""
        until = int(self.n_decisions[world]) + 1
        speed = torch.from_numpy(self._states["speed_mps"][:until, [world]])
        return bool(stands_nose_to_nose(speed, map_tensors(lambda field: field[[world]], moved), game))


def metrics(trace: Trace, braking_mps2: float, plan_s: float) -> dict[str, Any]:
    """`METRICS` of a trace of one episode, as plain numbers and texts."""
    drives = Drives(trace, braking_mps2, plan_s)
    values = {column.name: column.values(drives)[0] for column in COLUMNS if column.name in METRICS}
    return {name: value.item() for name, value in values.items()}
