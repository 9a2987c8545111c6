"""Encounters of a car with the simulator's other vehicles, on the held-out tasks of the evaluation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np
import torch

from negopipe.deployment.decision_file import street_of
from negopipe.deployment.host_street import HostStreet
from negopipe.deployment.negotiator import INTERVENTIONS, Negotiator
from negopipe.deployment.vehicle.body import CarState
from negopipe.deployment.vehicle.cars import build_car
from negopipe.deployment.vehicle.driver import Fleet, Vehicle, starts_of
from negopipe.deployment.vehicle.sensors import ObjectSensor
from negopipe.errors import UserError
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.trace import Trace
from negopipe.game.game import build_game
from negopipe.simulation.state import EGO, Task
from negopipe.tensors.tree import map_tensors

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

PLANNER = "vehicle"
"""Name of the planner in the records."""


@dataclass(frozen=True)
class Driven:
    """Encounters that were driven.

    trace: their record
    vehicles: of the egos, with the samples of the cars and what the runtime said
    """

    trace: Trace
    vehicles: Sequence[Vehicle]


class Encounters:
    """The tasks of a config, driven with an export.

    config: of the tasks: other vehicles, streets, `vehicle`, `evaluation`; the decisions are the export's
    load: makes a runtime, in the process that drives
    """

    def __init__(self, config: "RunConfig", load: Callable[[], Negotiator]) -> None:
        check(config)
        self.config, self._load, self.game = config, load, build_game(config)
        self._tasks = {name: held_out_tasks(config, self.game, name) for name in config.evaluation.settings}
        self._streets: dict[float, HostStreet] = {}

    @cached_property
    def _runtime(self) -> Negotiator:
        runtime, dt_s = self._load(), self.config.scenario.dt_s
        if runtime.settings.dt_s != dt_s:
            raise UserError(f"scenario.dt_s must be that of the export, {runtime.settings.dt_s} s, got {dt_s}")
        return runtime

    @torch.no_grad()
    def drive(self, car: str, setting: str, episodes: Sequence[int]) -> Driven:
        """Drive some tasks side by side; car: one of `cars.CARS`, episodes: numbers of the tasks in their setting."""
        tasks = map_tensors(lambda field: field[list(episodes)], self._tasks[setting])
        seen = self.game.perceive(self.game.simulator.reset(tasks)).of(EGO)
        vehicles = [
            self._vehicle(car, start, tasks, row, crc32(f"{setting} {episodes[row]}".encode()))
            for row, start in enumerate(starts_of(seen))
        ]
        paid, names = self.config.evaluation.reward, (PLANNER, setting)
        trace = drive_episodes(self.game, lambda key: Fleet(vehicles), tasks, len(tasks), paid, names, is_lockstep=True)
        intervention = np.zeros_like(trace.intervention)
        for row, vehicle in enumerate(vehicles):
            words = [INTERVENTIONS.index(said.intervention) for said in vehicle.said[: trace.n_steps[row]]]
            intervention[: len(words), row] = words
        return Driven(replace(trace, intervention=intervention), vehicles)

    def _vehicle(self, name: str, start: CarState, tasks: Task, row: int, seed: int) -> Vehicle:
        """A vehicle at the start of a task; the draws of its sensors are the same for every car."""
        config, direction = self.config, float(tasks.direction[row, EGO])
        rng = np.random.default_rng([config.evaluation.task_seed, seed])
        of_objects, of_car = rng.spawn(2)
        length_m, width_m = float(tasks.length[row, EGO]), float(tasks.width[row, EGO])
        runtime = self._runtime.anew(length_m, width_m, int(tasks.noise_seed[row]))
        car = build_car(name, start, config.vehicle, float(tasks.desired_speed[row, EGO]), of_car)
        sensor = ObjectSensor(config.vehicle.objects, of_objects)
        return Vehicle(runtime, self._street(direction), car, sensor, config.scenario.dt_s)

    def _street(self, direction: float) -> HostStreet:
        """The street of a direction, in the simulator's own frame."""
        if direction not in self._streets:
            street = street_of(self.game.simulator.road, round(abs(direction)))
            self._streets[direction] = self._runtime.street(street, float(np.sign(direction)), np.zeros(2), 0.0)
        return self._streets[direction]


def check(config: "RunConfig") -> None:
    """UserError where the simulator would do to the ego what the car, its sensors and the export do themselves."""
    sees = config.perception
    is_perfect = not (sees.position_std_m or sees.yaw_std_rad or sees.speed_std_mps or sees.delay_s or sees.occlusion)
    if not is_perfect or sees.dropout_probability or sees.range_m is not None:
        raise UserError("perception must be perfect in the tasks of a car, which has its own sensors, got another one")
    for key, kind, wanted in (("dynamics", config.dynamics.kind, "perfect"), ("safety", config.safety.kind, "none")):
        if kind != wanted:
            raise UserError(f"{key} must be {wanted} in the tasks of a car, which brings its own, got {kind}")
