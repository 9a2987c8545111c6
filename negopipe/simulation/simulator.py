"""Batched worlds: reset and step. State goes in, state comes out; nothing is hidden.

The simulator moves vehicles and tells what happened; who drives them (`negopipe.driver`) and what the ego is paid
(`negopipe.reward`) is not its business.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from negopipe.simulation.dynamics import Dynamics
from negopipe.simulation.geometry import boxes_from_pose, overlap_depth
from negopipe.simulation.perception import other_columns
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.state import AT_REST_MPS, Task, VehicleState, World

SETTLING_S = 1.0
"""Start of an episode in which rest does not count as being stuck: a task may start vehicles from rest."""


@dataclass(frozen=True)
class Events:
    """What a step led to, per world.

    is_success: [E] bool, every vehicle has reached its target and none has collided
    is_collision: [E] bool, footprints overlap, or one left the road or hit a parked car
    is_terminated: [E] bool, success or collision
    is_truncated: [E] bool, the time limit ended an episode that was not terminated
    """

    is_success: Tensor
    is_collision: Tensor
    is_terminated: Tensor
    is_truncated: Tensor


class Simulator:
    """The world's rules for one scenario.

    dynamics: how vehicles get to where their drivers want them
    history_steps: how many past poses and speeds a world remembers beside the present ones
    """

    def __init__(
        self, scenario: ScenarioConfig, history_steps: int, dynamics: Dynamics, device: torch.device | str = "cpu"
    ) -> None:
        self.scenario = scenario
        self.dynamics = dynamics
        self.history_steps = history_steps
        self.road = Road(scenario.road, device)
        self._others = other_columns(1 + scenario.n_social, device)

    def reset(self, task: Task) -> World:
        """Worlds [E] at the start of their tasks: own lane, along the road, at start speed."""
        s = -task.start_distance
        zero = torch.zeros_like(s)
        start = RouteState(s, task.start_speed, zero, *self.road.route_offset(s, task.direction))
        vehicles = replace(self.road.to_world(start, task.direction), speed=task.start_speed, accel=zero)
        no = torch.zeros_like(s, dtype=torch.bool)
        return World(
            vehicles=vehicles,
            reference=vehicles,
            task=task,
            step=torch.zeros_like(task.family),
            has_reached=no,
            has_collided=no,
            rest_steps=torch.zeros_like(s, dtype=torch.int64),
            has_switched=no,
            pose_history=self._repeat(_pose(vehicles)),
            speed_history=self._repeat(vehicles.speed),
            command_queue=s.new_zeros(len(task), self.dynamics.delay_steps, s.shape[1], 2),
        )

    def step(self, world: World, wanted: VehicleState) -> tuple[World, Events]:
        """Move every vehicle towards `wanted` [E, V], the state its driver wants one `dt_s` later."""
        motion, reference, command_queue = self.dynamics.move(world.vehicles, wanted, world.command_queue)
        s = self.road.progress(motion.position, world.task.direction)
        has_reached = world.has_reached | (s >= self.road.target_s_m)
        rest_steps, has_switched = self._styles(world, motion)
        moved = World(
            vehicles=motion,
            reference=reference,
            task=world.task,
            step=world.step + 1,
            has_reached=has_reached,
            has_collided=world.has_collided | self.collides(motion),
            rest_steps=rest_steps,
            has_switched=has_switched,
            pose_history=torch.cat([_pose(motion)[:, None], world.pose_history[:, :-1]], dim=1),
            speed_history=torch.cat([motion.speed[:, None], world.speed_history[:, :-1]], dim=1),
            command_queue=command_queue,
        )
        return moved, self._events(moved)

    def collides(self, vehicles: VehicleState) -> Tensor:
        """[E, V] bool: the true oriented footprint touches another vehicle, a parked car or the kerb."""
        size = self.scenario.vehicle
        x, y = vehicles.position.unbind(-1)
        boxes = boxes_from_pose(x, y, vehicles.yaw, size.length_m, size.width_m)

        def column(field: Tensor) -> Tensor:
            return field[..., None]

        own = boxes._replace(x=column(x), y=column(y), cos=column(boxes.cos), sin=column(boxes.sin))
        others = own._replace(
            x=x[:, self._others],
            y=y[:, self._others],
            cos=boxes.cos[:, self._others],
            sin=boxes.sin[:, self._others],
        )
        hits_parked = (overlap_depth(own, self.road.parked_boxes()) > 0).any(-1)
        return (overlap_depth(own, others) > 0).any(-1) | hits_parked | self.road.is_off_road(boxes)

    def _repeat(self, start: Tensor) -> Tensor:
        """[E, ...] -> [E, K, ...]: a history in which nothing has happened yet."""
        return start[:, None].repeat(1, 1 + self.history_steps, *[1] * (start.dim() - 1))

    def _styles(self, world: World, motion: VehicleState) -> tuple[Tensor, Tensor]:
        """`rest_steps` and `has_switched` of the world in which `motion` is reached, [E, V] each."""
        dt = self.scenario.dt_s
        time = (world.step[:, None] + 1) * dt
        is_stuck = (motion.speed < AT_REST_MPS) & (time > SETTLING_S + dt / 2)
        rest_steps = torch.where(is_stuck, world.rest_steps + 1, 0)
        has_lost_patience = is_stuck & (rest_steps * dt > world.task.patience - dt / 2)
        return rest_steps, world.has_switched | has_lost_patience | (time > world.task.switch_time - dt / 2)

    def _events(self, world: World) -> Events:
        is_collision = world.has_collided.any(-1)
        is_success = world.has_reached.all(-1) & ~is_collision
        is_terminated = is_collision | is_success
        is_over = world.step >= self.scenario.episode_steps
        return Events(is_success, is_collision, is_terminated, is_over & ~is_terminated)


def _pose(vehicles: VehicleState) -> Tensor:
    return torch.cat([vehicles.position, vehicles.yaw[..., None]], dim=-1)
