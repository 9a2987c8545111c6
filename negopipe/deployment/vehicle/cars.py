"""Cars that drive trajectories: a real one with its controller and actuators, and one that is where its plan says."""

from collections import deque
from typing import NamedTuple, Protocol

import numpy as np

from negopipe.deployment.messages import Array, EgoState, Trajectory
from negopipe.deployment.vehicle.actuators import Actuators
from negopipe.deployment.vehicle.body import CarState, body_at, car_state
from negopipe.deployment.vehicle.controller import Controller
from negopipe.deployment.vehicle.multi_body import NUMBERS, MultiBody
from negopipe.deployment.vehicle.options import VehicleConfig
from negopipe.deployment.vehicle.path import Path, error
from negopipe.deployment.vehicle.plant import DrivingModel, Plant
from negopipe.deployment.vehicle.sensors import Localisation, carried_on

PERFECT = "perfect"
"""Name of the car that is where its plan says."""

CARS = (*NUMBERS, PERFECT)


class Sample(NamedTuple):
    """A car beside its plan at a time.

    car: its state
    ahead_m, left_m: of its plan, along and across the plan's heading; turned_rad: of its heading, to the left
    """

    time_s: float
    car: CarState
    ahead_m: float
    left_m: float
    turned_rad: float


class Car(Protocol):
    """A car on a drive.

    state: now
    samples: since the start, one per `control_s`
    """

    state: CarState
    samples: list[Sample]

    def tell(self, now_s: float) -> EgoState:
        """The own state, as far as the car knows it."""
        ...

    def drive(self, plan: Trajectory, now_s: float, until_s: float) -> None:
        """Drive on; plan: decided now."""
        ...


class RealCar:
    """A model of a car with actuators, a controller and an own state that is known with errors."""

    def __init__(self, model: DrivingModel, start: CarState, config: VehicleConfig, known: Localisation) -> None:
        self.state, self.samples = start, list[Sample]()
        self.plant = Plant(model, body_at(start, model.geometry), config.hand_over_mps, config.plant_s)
        self._config, self._known, self._geometry = config, known, model.geometry
        self._actuators = Actuators(config.actuators, model.geometry, config.plant_s)
        self._controller = Controller(config.controller, model.geometry)
        self._path: Path | None = None
        self._decided: deque[tuple[float, Path]] = deque()
        self._n_substeps = round(config.control_s / config.plant_s)
        for back in range(round(config.localisation.delay_s / config.control_s) + 1, -1, -1):
            before_s = -back * config.control_s
            known.measure(before_s, _driven_back(start, before_s))

    def tell(self, now_s: float) -> EgoState:
        return self._known.newest(now_s)

    def drive(self, plan: Trajectory, now_s: float, until_s: float) -> None:
        """Drive by the last plan until the new one is there."""
        config, path = self._config, Path(plan)
        if self._path is None:
            self._path = path  # a drive begins with a plan
        self._decided.append((now_s + config.decision_delay_s, path))
        for index in range(round((until_s - now_s) / config.control_s)):
            self._control(now_s + index * config.control_s)

    def _control(self, time_s: float) -> None:
        """One step of the controller."""
        while self._decided and self._decided[0][0] <= time_s + 1e-9:
            self._path = self._decided.popleft()[1]
        path = self._path
        assert path is not None
        command = self._controller.command(path, time_s, carried_on(self._known.newest(time_s), time_s))
        for _ in range(self._n_substeps):
            rate, accel = self._actuators.step(command, self.plant.body.steer)
            self.plant.step(rate, accel, command.gear)
        after_s = time_s + self._config.control_s
        accel = self._actuators.accel if self.plant.body.speed else 0.0
        self.state = car_state(self.plant.body, accel, self._geometry)
        self._known.measure(after_s, self.state)
        self.samples.append(_sample(path, after_s, self.state))


class PerfectCar:
    """A car that is where its plan says, and knows it."""

    def __init__(self, start: CarState, config: VehicleConfig, desired_speed: float) -> None:
        self.state, self.samples = start, list[Sample]()
        self._control_s, self._desired_speed = config.control_s, desired_speed

    def tell(self, now_s: float) -> EgoState:
        return EgoState(now_s, *self.state, self._desired_speed)

    def drive(self, plan: Trajectory, now_s: float, until_s: float) -> None:
        """See `Car.drive`."""
        path = Path(plan)
        for index in range(1, round((until_s - now_s) / self._control_s) + 1):
            time_s = now_s + index * self._control_s
            self.state = CarState(*path.at(time_s))
            self.samples.append(_sample(path, time_s, self.state))


def build_car(
    name: str, start: CarState, config: VehicleConfig, desired_speed: float, rng: np.random.Generator
) -> RealCar | PerfectCar:
    """A car at the start of a drive; name: one of `CARS`."""
    if name == PERFECT:
        return PerfectCar(start, config, desired_speed)
    return RealCar(MultiBody(name), start, config, Localisation(config.localisation, desired_speed, rng))


def tracked(samples: list[Sample]) -> Array:
    """[T, 3]: `ahead_m`, `left_m`, `turned_rad` of the samples."""
    return np.array([[each.ahead_m, each.left_m, each.turned_rad] for each in samples])


def _sample(path: Path, time_s: float, car: CarState) -> Sample:
    return Sample(time_s, car, *error(path.at(time_s), car.x, car.y, car.yaw))


def _driven_back(start: CarState, time_s: float) -> CarState:
    """The state before the start, time_s < 0."""
    driven = start.speed * time_s
    return start._replace(x=start.x + driven * np.cos(start.yaw), y=start.y + driven * np.sin(start.yaw))
