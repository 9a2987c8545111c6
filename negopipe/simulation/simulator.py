"""The simulator of batched worlds: reset and step. State goes in, state comes out.

It moves vehicles, lets their trackers follow and reports events. Drivers (`negopipe.agents.driver`) and the reward
(`negopipe.game.reward`) are not part of it.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from negopipe.simulation.build_road import build_road
from negopipe.simulation.collisions import PASSING_M, CollisionCheck
from negopipe.simulation.dynamics import Dynamics
from negopipe.simulation.geometry import Size
from negopipe.simulation.perception import Sensor, other_columns
from negopipe.simulation.road import RouteState
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.state import AT_REST_MPS, EGO, Task, VehicleState, World
from negopipe.simulation.tracker import no_tracks
from negopipe.tensors.tree import map_tensors, tree_where

UNCOUNTED_REST_S = 1.0
"""Time from the start of an episode in which rest does not count as being stuck: a task may start vehicles at rest."""


@dataclass(frozen=True)
class Events:
    """Events of one step, per world.

    is_success: [E] bool, every vehicle has reached its target and none has collided; after a collision among social
        vehicles the ego's arrival is enough
    is_collision: [E] bool, the ego has touched another vehicle, a parked car or a kerb
    is_social_collision: [E] bool, only social vehicles have collided, now or earlier in the episode
    is_terminated: [E] bool, success or collision
    is_truncated: [E] bool, an episode that was not terminated is over: by the time limit, or because a collision among
        social vehicles blocks the route of the ego
    """

    is_success: Tensor
    is_collision: Tensor
    is_social_collision: Tensor
    is_terminated: Tensor
    is_truncated: Tensor


class Simulator:
    """The simulator of one scenario.

    sensor: of every vehicle; a world remembers as much as it needs
    dynamics: motion of the vehicles towards the states that their drivers want
    n_kept: K, numbers that the safety layer keeps of a stop
    """

    def __init__(
        self,
        scenario: ScenarioConfig,
        sensor: Sensor,
        dynamics: Dynamics,
        device: torch.device | str = "cpu",
        n_kept: int = 0,
    ) -> None:
        self.scenario, self.sizes = scenario, scenario.sizes
        self.sensor = sensor
        self.dynamics = dynamics
        self.n_kept = n_kept
        self.road = build_road(scenario, device)
        others = other_columns(scenario.n_vehicles, device)
        self.collisions = CollisionCheck(self.road, scenario.dt_s, others)

    def reset(self, task: Task) -> World:
        """Worlds [E] at the start of their tasks: own lane, along the road, at start speed."""
        s = -task.start_distance
        zero = torch.zeros_like(s)
        start = RouteState(s, task.start_speed, zero, *self.road.route_offset(s, task.direction))
        vehicles = replace(self.road.to_world(start, task.direction), speed=task.start_speed, accel=zero)
        no = torch.zeros_like(s, dtype=torch.bool)
        world = World(
            vehicles=vehicles,
            reference=vehicles,
            task=task,
            step=torch.zeros_like(task.family),
            has_reached=no,
            has_collided=no,
            rest_steps=torch.zeros_like(s, dtype=torch.int64),
            last_horizon=torch.full_like(s, torch.nan),
            has_switched=no,
            pose_history=self._repeat(_pose(vehicles)),
            speed_history=self._repeat(vehicles.speed),
            command_queue=s.new_zeros(len(task), self.dynamics.delay_steps, s.shape[1], 2),
            tracks=no_tracks(s),
            kept_stop=s.new_full((len(task), self.n_kept), torch.nan),
        )
        return replace(world, tracks=self.sensor.first_tracks(world))

    def place(self, world: World, vehicles: VehicleState) -> World:
        """`world` with its vehicles elsewhere, as if they had always been there; `vehicles` [E, V]."""
        placed = replace(
            world,
            vehicles=vehicles,
            reference=vehicles,
            pose_history=self._repeat(_pose(vehicles)),
            speed_history=self._repeat(vehicles.speed),
        )
        return replace(placed, tracks=self.sensor.first_tracks(placed))

    def step(self, world: World, wanted: VehicleState) -> tuple[World, Events]:
        """Move every vehicle towards `wanted` [E, V], the state its driver wants one `dt_s` later.

        Social vehicles that have collided stand still while the episode goes on.
        """
        motion, reference, command_queue = self.dynamics.move(world.vehicles, wanted, world.command_queue)
        still = torch.zeros_like(world.vehicles.speed)
        at_rest = replace(world.vehicles, speed=still, accel=still)
        is_wreck = world.has_collided & ~world.has_collided[:, EGO : EGO + 1]
        motion, reference = (tree_where(is_wreck, at_rest, state) for state in (motion, reference))
        contact = self.collisions.first_contact(world.vehicles, motion, world.task.direction, self.size(world.task))
        contact = torch.where(world.has_collided, torch.inf, contact)
        motion = self.collisions.moved_until(contact, world.vehicles, motion)
        s = self.road.progress(motion.position, world.task.direction)
        has_reached = world.has_reached | (s >= self.road.target_s(world.task.direction))
        rest_steps, has_switched = self._styles(world, motion)
        moved = World(
            vehicles=motion,
            reference=reference,
            task=world.task,
            step=world.step + 1,
            has_reached=has_reached,
            has_collided=world.has_collided | contact.isfinite(),
            rest_steps=rest_steps,
            last_horizon=world.last_horizon,
            has_switched=has_switched,
            pose_history=torch.cat([_pose(motion)[:, None], world.pose_history[:, :-1]], dim=1),
            speed_history=torch.cat([motion.speed[:, None], world.speed_history[:, :-1]], dim=1),
            command_queue=command_queue,
            tracks=world.tracks,
            kept_stop=world.kept_stop,
        )
        moved = replace(moved, tracks=self.sensor.next_tracks(moved))
        return moved, self._events(moved, s)

    def size(self, task: Task) -> Size:
        """Of the vehicles, [E, V], or floats where all are alike."""
        return self.sizes.of(task.length, task.width)

    def touches(self, world: World) -> Tensor:
        """[E, V] bool: the footprint touches another vehicle, a parked car or a kerb."""
        return self.collisions.touches(world.vehicles, world.task.direction, self.size(world.task))

    def _repeat(self, start: Tensor) -> Tensor:
        """[E, ...] -> [E, K, ...]: the history at the start of an episode."""
        return start[:, None].repeat(1, 1 + self.sensor.memory_steps, *[1] * (start.dim() - 1))

    def _styles(self, world: World, motion: VehicleState) -> tuple[Tensor, Tensor]:
        """New `rest_steps` and `has_switched` of a world whose vehicles have reached `motion`, [E, V] each."""
        dt = self.scenario.dt_s
        time = (world.step[:, None] + 1) * dt
        is_stuck = (motion.speed.abs() < AT_REST_MPS) & (time > UNCOUNTED_REST_S + dt / 2)
        rest_steps = torch.where(is_stuck, world.rest_steps + 1, 0)
        has_lost_patience = is_stuck & (rest_steps * dt > world.task.patience - dt / 2)
        return rest_steps, world.has_switched | has_lost_patience | (time > world.task.switch_time - dt / 2)

    def _events(self, world: World, s: Tensor) -> Events:
        """Events of a world that a step has led to; s: [E, V] m, of the vehicles on their routes."""
        has_arrived, has_collided = world.has_reached, world.has_collided
        is_collision = has_collided[:, EGO]
        is_social_collision = has_collided[:, EGO + 1 :].any(-1) & ~is_collision
        is_success = has_arrived.all(-1) | (is_social_collision & has_arrived[:, EGO])
        is_success = is_success & ~is_collision
        is_terminated = is_collision | is_success
        is_over = (world.step >= self.scenario.episode_steps) | (
            is_social_collision & self._is_blocked(world, s[:, EGO])
        )
        return Events(is_success, is_collision, is_social_collision, is_terminated, is_over & ~is_terminated)

    def _is_blocked(self, world: World, s: Tensor) -> Tensor:
        """[E] bool: a wreck stands on the route of the ego, ahead of its place `s` [E] (m)."""
        wrecks = map_tensors(lambda field: field[:, EGO + 1 :], world.vehicles)
        direction = world.task.direction[:, EGO : EGO + 1]
        is_ahead = self.road.progress(wrecks.position, direction) > s[:, None]
        task = world.task
        size = self.sizes.of(task.length[:, EGO + 1 :], task.width[:, EGO + 1 :])
        is_on_route = self.collisions.stands_on_route(wrecks, size, direction, self.sizes.ego, PASSING_M)
        return (world.has_collided[:, EGO + 1 :] & is_ahead & is_on_route).any(-1)


def _pose(vehicles: VehicleState) -> Tensor:
    return torch.cat([vehicles.position, vehicles.yaw[..., None]], dim=-1)
