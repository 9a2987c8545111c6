"""The egos of the simulator's evaluation, each driven by a car, its sensors and the runtime."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from negopipe.deployment.host_street import HostStreet
from negopipe.deployment.messages import Array, Diagnostics, Trajectory
from negopipe.deployment.negotiator import Negotiator
from negopipe.deployment.vehicle.body import CarState
from negopipe.deployment.vehicle.cars import Car
from negopipe.deployment.vehicle.sensors import ObjectSensor, Others
from negopipe.simulation.perception import Perception
from negopipe.simulation.state import Motion, VehicleState


class Vehicle:
    """A car with its sensors and the runtime, on one drive.

    decided: what the runtime said, per decision
    """

    def __init__(self, runtime: Negotiator, street: HostStreet, car: Car, sensor: ObjectSensor, dt_s: float) -> None:
        self.car, self.decided = car, list[Trajectory]()
        self._runtime, self._street, self._sensor, self._dt_s = runtime, street, sensor, dt_s

    @property
    def said(self) -> list[Diagnostics]:
        """What the runtime did about its inputs, per decision."""
        return [plan.diagnostics for plan in self.decided]

    def drive(self, others: Array) -> None:
        """Decide and drive until the next decision; others: `Others.rows` as they are now."""
        now_s = len(self.decided) * self._dt_s
        objects = self._sensor.hear(Others(now_s, others))
        plan = self._runtime.decide(self.car.tell(now_s), objects, self._street, now_s)
        self.decided.append(plan)
        self.car.drive(plan, now_s, now_s + self._dt_s)

    def is_at(self, x: float, y: float) -> bool:
        """Whether the car is there: an episode that is over stays where it ended, and its car would drive on."""
        return bool(np.float32(self.car.state.x) == np.float32(x) and np.float32(self.car.state.y) == np.float32(y))


class Fleet:
    """Driver of the egos of E worlds, one vehicle each; all worlds are driven in lockstep.

    The worlds' perception must be perfect: the errors are those of the vehicles' sensors.
    """

    def __init__(self, vehicles: Sequence[Vehicle]) -> None:
        self.vehicles = vehicles

    def drive(self, perception: Perception) -> Motion:
        """Where the cars get until the next decision, [E, 1]."""
        others, at = others_of(perception), perception.own.position[:, 0].tolist()
        for vehicle, rows, (x, y) in zip(self.vehicles, others, at, strict=True):
            if vehicle.is_at(x, y):
                vehicle.drive(rows)
        last = [vehicle.decided[-1] for vehicle in self.vehicles]
        horizon = torch.tensor([plan.horizon_s for plan in last])[:, None]
        return Motion(self._states(), horizon, torch.tensor([plan.is_full_braking for plan in last])[:, None])

    def _states(self) -> VehicleState:
        states = torch.tensor([vehicle.car.state for vehicle in self.vehicles], dtype=torch.float32)[:, None]
        return VehicleState(states[..., :2], *states[..., 2:].unbind(-1))


def others_of(perception: Perception) -> Array:
    """[E, O, 6]: `Others.rows` as a perfect perception of one agent sees them."""
    other = perception.other
    columns = [*other.position.unbind(-1), other.yaw, other.speed, perception.other_length, perception.other_width]
    return torch.stack(columns, -1)[:, 0].double().numpy()


def starts_of(perception: Perception) -> list[CarState]:
    """States of the agents of E worlds."""
    own = perception.own
    columns: list[Tensor] = [*own.position.unbind(-1), own.yaw, own.speed, own.accel, own.curvature]
    return [CarState(*row) for row in torch.cat(columns, 1).tolist()]
