"""The ego of the simulator's evaluation, driven by a car, its sensors and the runtime."""


import torch
from torch import Tensor

from negopipe.deployment.host_street import HostStreet
from negopipe.deployment.messages import Diagnostics, Trajectory
from negopipe.deployment.negotiator import Negotiator
from negopipe.deployment.vehicle.body import CarState
from negopipe.deployment.vehicle.cars import Car
from negopipe.deployment.vehicle.sensors import ObjectSensor, Others
from negopipe.simulation.perception import Perception
from negopipe.simulation.state import Motion, VehicleState


class VehicleDriver:
    """Drives the ego of one world (E = 1): sees the others as they are, and returns where the car gets.

    The world's perception must be perfect: the errors are those of the sensors here.

    decided: what the runtime said, per decision
    """

    def __init__(self, runtime: Negotiator, street: HostStreet, car: Car, sensor: ObjectSensor, dt_s: float) -> None:
        self.car, self.decided = car, list[Trajectory]()
        self._runtime, self._street, self._sensor, self._dt_s = runtime, street, sensor, dt_s

    def drive(self, perception: Perception) -> Motion:
        """The motion of the car until the next decision, [1, 1]."""
        now_s = len(self.decided) * self._dt_s
        objects = self._sensor.hear(others_of(perception, now_s))
        plan = self._runtime.decide(self.car.tell(now_s), objects, self._street, now_s)
        self.decided.append(plan)
        self.car.drive(plan, now_s, now_s + self._dt_s)
        return Motion(
            _vehicle_state(self.car.state),
            torch.full((1, 1), plan.horizon_s, dtype=torch.float32),
            torch.full((1, 1), plan.is_full_braking),
        )

    @property
    def said(self) -> list[Diagnostics]:
        """What the runtime did about its inputs, per decision."""
        return [plan.diagnostics for plan in self.decided]


def others_of(perception: Perception, time_s: float) -> Others:
    """The others as a perfect perception of one agent in one world sees them."""
    other = perception.other
    columns = [other.position[0, 0, :, 0], other.position[0, 0, :, 1], other.yaw[0, 0], other.speed[0, 0]]
    columns += [perception.other_length[0, 0], perception.other_width[0, 0]]
    return Others(time_s, torch.stack(columns, -1).double().numpy())


def start_of(perception: Perception) -> CarState:
    """The state of the agent."""
    own = perception.own
    numbers = [own.position[..., 0], own.position[..., 1], own.yaw, own.speed, own.accel, own.curvature]
    return CarState(*(float(number) for number in numbers))


def _vehicle_state(car: CarState) -> VehicleState:
    def one(number: float) -> Tensor:
        return torch.full((1, 1), number, dtype=torch.float32)

    return VehicleState(torch.tensor([[[car.x, car.y]]], dtype=torch.float32), *(one(number) for number in car[2:]))
