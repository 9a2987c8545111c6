"""Vehicle dynamics: the state reached one control step after a driver has chosen a state, exactly or as a car would."""

import math
from collections.abc import Iterator
from typing import Annotated, Literal, Protocol

import torch
from pydantic import Field
from torch import Tensor

from negopipe.checks import Problem, check_times
from negopipe.schema import NonNegativeFloat, PositiveFloat, PositiveInt, PositiveMetres, schema
from negopipe.simulation.geometry import wrap_angle
from negopipe.simulation.state import VehicleState
from negopipe.tensors.tree import tree_where

SteerDegrees = Annotated[float, Field(gt=0, lt=90)]


@schema
class PerfectConfig:
    """Perfect tracking: a vehicle reaches the planned state."""

    kind: Literal["perfect"]

    def check(self, dt_s: float) -> Iterator[Problem]:
        yield from ()

    def delay_steps(self, dt_s: float) -> int:
        """D, control steps from a command to the actuators."""
        return 0


@schema
class BicycleConfig:
    """A kinematic bicycle that tracks the plan; `conf/dynamics/bicycle.yaml` says what each value means."""

    kind: Literal["bicycle"]
    wheelbase_m: PositiveMetres
    steer_max_deg: SteerDegrees
    steer_rate_max_degps: PositiveFloat
    accel_time_constant_s: PositiveFloat
    steer_time_constant_s: PositiveFloat
    actuation_delay_s: NonNegativeFloat
    n_substeps: PositiveInt
    position_gain_1ps2: NonNegativeFloat
    heading_distance_m: PositiveMetres
    lateral_gain_1pm2: NonNegativeFloat
    replan_distance_m: PositiveMetres

    def check(self, dt_s: float) -> Iterator[Problem]:
        yield from check_times({"dynamics.actuation_delay_s": (self.actuation_delay_s,)}, dt_s)

    def delay_steps(self, dt_s: float) -> int:
        """D, control steps from a command to the actuators."""
        return round(self.actuation_delay_s / dt_s)


DynamicsConfig = Annotated[PerfectConfig | BicycleConfig, Field(discriminator="kind")]


class Dynamics(Protocol):
    """The motion of vehicles during one control step.

    delay_steps: control steps D from a command to the actuators
    """

    delay_steps: int

    def move(
        self, vehicles: VehicleState, wanted: VehicleState, queue: Tensor
    ) -> tuple[VehicleState, VehicleState, Tensor]:
        """State [E, V] reached one control step later, state [E, V] to plan from then, and command queue [E, D, V, 2].

        vehicles: VehicleState [E, V], now
        wanted: VehicleState [E, V], chosen by the drivers for one control step later
        queue: [E, D, V, 2] float32, commands on their way to the actuators, the oldest first: acceleration (m/s2),
            steering angle (rad)
        """
        ...


def build_dynamics(config: PerfectConfig | BicycleConfig, dt_s: float) -> Dynamics:
    """Dynamics of a config, with control steps of `dt_s`."""
    return Bicycle(config, dt_s) if isinstance(config, BicycleConfig) else Perfect()


class Perfect:
    """Perfect tracking: every vehicle reaches the state that its driver wants."""

    delay_steps = 0

    def move(
        self, vehicles: VehicleState, wanted: VehicleState, queue: Tensor
    ) -> tuple[VehicleState, VehicleState, Tensor]:
        """See `Dynamics.move`."""
        return wanted, wanted, queue


class Bicycle:
    """A kinematic bicycle whose reference point is the footprint's centre and moves along its heading.

    The planner makes the same assumption (no slip: the heading is that of the path). The steering angle is therefore
    atan(wheelbase * curvature), and a `VehicleState` holds the state of the actuators too. The centre of a real car
    runs a little outside of its heading in a bend (with rear-axle steering geometry by
    asin(curvature * wheelbase / 2)). That slip is left out, as in Waymax's bicycle model (Gulino 2023).
    """

    def __init__(self, config: BicycleConfig, dt_s: float) -> None:
        self.config, self.dt_s = config, dt_s
        self.delay_steps = config.delay_steps(dt_s)
        self._substep_s = dt_s / config.n_substeps
        self._accel_share = 1 - math.exp(-self._substep_s / config.accel_time_constant_s)
        self._steer_share = 1 - math.exp(-self._substep_s / config.steer_time_constant_s)
        self._steer_max = math.radians(config.steer_max_deg)
        self._steer_change_max = math.radians(config.steer_rate_max_degps) * self._substep_s

    def move(
        self, vehicles: VehicleState, wanted: VehicleState, queue: Tensor
    ) -> tuple[VehicleState, VehicleState, Tensor]:
        """See `Dynamics.move`.

        The next plan starts from the planned state, so that it does not inherit the tracking error of the one before.
        It starts from the car's own state where the two are more than `replan_distance_m` apart.
        """
        queue = torch.cat([queue, self.command(vehicles, wanted)[:, None]], dim=1)
        moved = self.actuate(vehicles, queue[:, 0], _gear(vehicles.speed, wanted.speed))
        is_lost = (moved.position - wanted.position).norm(dim=-1) > self.config.replan_distance_m
        return moved, tree_where(is_lost, moved, wanted), queue[:, 1:]

    def command(self, vehicles: VehicleState, wanted: VehicleState) -> Tensor:
        """[E, V, 2] float32: acceleration (m/s2) and steering angle (rad) that lead to the wanted state.

        Feedforward reaches the wanted speed and, at driving speed, the wanted heading within one step. Lead terms
        compensate the lag of the actuators. Feedback corrects the position error that the wanted arc would leave.
        """
        gear = _gear(vehicles.speed, wanted.speed)
        travelled = (vehicles.speed + wanted.speed) / 2 * self.dt_s
        position, yaw = _along_arc(vehicles.position, vehicles.yaw, wanted.curvature, travelled)
        error = wanted.position - position
        ahead = error[..., 0] * torch.cos(yaw) + error[..., 1] * torch.sin(yaw)
        left = error[..., 1] * torch.cos(yaw) - error[..., 0] * torch.sin(yaw)
        gains = self.config
        accel_lead = gains.accel_time_constant_s * (wanted.accel - vehicles.accel)
        accel = (wanted.speed - vehicles.speed + accel_lead) / self.dt_s + gains.position_gain_1ps2 * ahead
        curvature_lead = gains.steer_time_constant_s * (wanted.curvature - vehicles.curvature) / self.dt_s
        turn = gear * wrap_angle(wanted.yaw - yaw) / travelled.abs().clamp(min=gains.heading_distance_m)
        curvature = wanted.curvature + curvature_lead + turn + gains.lateral_gain_1pm2 * left
        return torch.stack([accel, torch.atan(gains.wheelbase_m * curvature)], dim=-1)

    def actuate(self, vehicles: VehicleState, command: Tensor, gear: Tensor | float = 1.0) -> VehicleState:
        """State [E, V] after one control step in which the actuators approach `command` [E, V, 2].

        gear: [E, V] float32, +1 forwards, -1 backwards, or one for all
        """
        wanted_accel = command[..., 0]
        wanted_steer = command[..., 1].clamp(-self._steer_max, self._steer_max)
        position, yaw, speed, accel = vehicles.position, vehicles.yaw, vehicles.speed, vehicles.accel
        steer, h = torch.atan(self.config.wheelbase_m * vehicles.curvature), self._substep_s
        curvature = vehicles.curvature
        for _ in range(self.config.n_substeps):
            accel = accel + self._accel_share * (wanted_accel - accel)
            change = self._steer_share * (wanted_steer - steer)
            steer = steer + change.clamp(-self._steer_change_max, self._steer_change_max)
            curvature = torch.tan(steer) / self.config.wheelbase_m
            until_rest_s = speed.abs() / accel.abs().clamp(min=1e-6)
            moving_s = torch.where(gear * accel < 0, until_rest_s.clamp(max=h), h)
            travelled = speed * moving_s + accel * moving_s**2 / 2
            position, yaw = _along_arc(position, yaw, curvature, travelled)
            speed = torch.where(moving_s < h, 0.0, gear * (gear * (speed + accel * h)).clamp(min=0))
            accel = torch.where((speed == 0) & (gear * accel < 0), 0.0, accel)  # brakes hold, they do not push back
        return VehicleState(position, yaw, speed, accel, curvature)


def _gear(speed: Tensor, wanted_speed: Tensor) -> Tensor:
    """[...] float32, +1 forwards or -1 backwards: of a vehicle that moves so, or that stands and wants to."""
    return torch.where((speed < 0) | ((speed == 0) & (wanted_speed < 0)), -1.0, 1.0)


def _along_arc(position: Tensor, yaw: Tensor, curvature: Tensor, travelled: Tensor) -> tuple[Tensor, Tensor]:
    """Position [..., 2] (m) and yaw [...] (rad) after `travelled` [...] (m) on a circle of `curvature` (1/m)."""
    turn = curvature * travelled
    chord = travelled * torch.sinc(turn / (2 * math.pi))
    middle = yaw + turn / 2
    step = torch.stack([chord * torch.cos(middle), chord * torch.sin(middle)], dim=-1)
    return position + step, wrap_angle(yaw + turn)
