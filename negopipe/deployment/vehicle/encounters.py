"""Encounters of a car with the simulator's other vehicles, on the held-out tasks of the evaluation."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np
import torch

from negopipe.deployment.decision_file import street_of
from negopipe.deployment.host_street import HostStreet
from negopipe.deployment.negotiator import INTERVENTIONS, Negotiator
from negopipe.deployment.vehicle.cars import Car, build_car
from negopipe.deployment.vehicle.driver import VehicleDriver, start_of
from negopipe.deployment.vehicle.sensors import ObjectSensor
from negopipe.errors import UserError
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.trace import Trace
from negopipe.game.game import Game, build_game
from negopipe.simulation.state import EGO, Task
from negopipe.tensors.tree import map_tensors

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

PLANNER = "vehicle"
"""Name of the planner in the records."""


@dataclass(frozen=True)
class Driven:
    """An encounter that was driven.

    trace: its record, E = 1
    driver: the ego's, with the samples of the car and what the runtime said
    """

    trace: Trace
    driver: VehicleDriver

    @property
    def car(self) -> Car:
        return self.driver.car


class Encounters:
    """The tasks of a config, driven with an export.

    config: of the tasks: other vehicles, streets, `vehicle`, `evaluation`; the decisions are the export's
    load: makes a runtime, in the process that drives
    """

    def __init__(self, config: "RunConfig", load: Callable[[], Negotiator]) -> None:
        check(config)
        self.config, self._load = config, load
        self.game: Game = build_game(config)
        self._tasks = {name: held_out_tasks(config, self.game, name) for name in config.evaluation.settings}
        self._streets: dict[float, HostStreet] = {}

    @cached_property
    def _runtime(self) -> Negotiator:
        runtime, dt_s = self._load(), self.config.scenario.dt_s
        if runtime.settings.dt_s != dt_s:
            raise UserError(f"scenario.dt_s must be that of the export, {runtime.settings.dt_s} s, got {dt_s}")
        return runtime

    @torch.no_grad()
    def drive(self, car: str, setting: str, episode: int) -> Driven:
        """Drive one task; car: one of `cars.CARS`, episode: number of the task in its setting."""
        task = map_tensors(lambda field: field[episode : episode + 1], self._tasks[setting])
        driver = self._driver(car, task, crc32(f"{setting} {episode}".encode()))
        trace = drive_episodes(
            self.game, lambda key: driver, task, 1, self.config.evaluation.reward, (PLANNER, setting)
        )
        words = [INTERVENTIONS.index(said.intervention) for said in driver.said]
        intervention = np.zeros_like(trace.intervention)
        intervention[: len(words), 0] = words
        return Driven(replace(trace, intervention=intervention), driver)

    def _driver(self, name: str, task: Task, seed: int) -> VehicleDriver:
        """Draws are the same for every car."""
        config = self.config
        seen = self.game.perceive(self.game.simulator.reset(task)).of(EGO)
        rng = np.random.default_rng([config.evaluation.task_seed, seed])
        of_objects, of_car = rng.spawn(2)
        runtime = self._runtime.anew(float(task.length[0, EGO]), float(task.width[0, EGO]))
        car = build_car(name, start_of(seen), config.vehicle, float(task.desired_speed[0, EGO]), of_car)
        sensor = ObjectSensor(config.vehicle.objects, of_objects)
        return VehicleDriver(runtime, self._street(float(task.direction[0, EGO])), car, sensor, config.scenario.dt_s)

    def _street(self, direction: float) -> HostStreet:
        """The street of a direction in the simulator's own frame."""
        if direction not in self._streets:
            street = street_of(self.game.simulator.road, round(abs(direction)))
            self._streets[direction] = self._runtime.street(street, float(np.sign(direction)), np.zeros(2), 0.0)
        return self._streets[direction]


def runtime_of(folder: Path) -> Callable[[], Negotiator]:
    """Loads the runtime of an export's folder."""
    return lambda: Negotiator.load(folder)


def check(config: "RunConfig") -> None:
    """UserError where the simulator would do to the ego what the car, its sensors and the export do themselves."""
    for key, kind, wanted in (
        ("dynamics", config.dynamics.kind, "perfect"),
        ("safety", config.safety.kind, "none"),
        ("perception.delay_s", config.perception.delay_s, 0.0),
        ("perception.dropout_probability", config.perception.dropout_probability, 0.0),
        ("perception.position_std_m", config.perception.position_std_m, 0.0),
        ("perception.occlusion", config.perception.occlusion, False),
    ):
        if kind != wanted:
            raise UserError(f"{key} must be {wanted} in the tasks of a car, which brings its own, got {kind}")
