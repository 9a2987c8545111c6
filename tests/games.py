"""Tasks and configs for tests that drive."""

from dataclasses import replace

import torch
from composed import compose_config
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.game.game import Game
from negopipe.simulation.road import RouteState
from negopipe.simulation.scenario import FamilyConfig, TaskSampler
from negopipe.simulation.state import Task, VehicleState, World
from negopipe.tensors.tree import map_tensors

IN_ONE_PROCESS = ("device=cpu", "n_threads=1", "compile='off'", "scenario.episode_steps=72")

MIXTURE = {"mixture": FamilyConfig(1.0, (11.99, 18.80), [], [0.0, 2.0, 4.0, 6.0], None)}


def tiny_config(experiment: str, *overrides: str) -> RunConfig:
    """An experiment in one process, without a compiler and with short episodes."""
    return compose_config([f"+experiment={experiment}", *IN_ONE_PROCESS, *overrides])


def place(world: World, vehicles: VehicleState) -> World:
    """`world` with its vehicles elsewhere, as if they had always been there."""
    pose = torch.cat([vehicles.position, vehicles.yaw[..., None]], dim=-1)
    return replace(
        world,
        vehicles=map_tensors(torch.clone, vehicles),
        reference=map_tensors(torch.clone, vehicles),
        pose_history=pose[:, None].expand_as(world.pose_history).contiguous(),
        speed_history=vehicles.speed[:, None].expand_as(world.speed_history).contiguous(),
    )


def pass_through(game: Game, world: World, wanted: VehicleState) -> World:
    """The world one step later, in which vehicles drive on through each other, for tests of motion alone."""
    moved, _ = game.simulator.step(world, wanted)
    pose = torch.cat([wanted.position, wanted.yaw[..., None]], dim=-1)
    return replace(
        moved,
        vehicles=wanted,
        reference=wanted,
        has_collided=torch.zeros_like(moved.has_collided),
        pose_history=torch.cat([pose[:, None], moved.pose_history[:, 1:]], dim=1),
        speed_history=torch.cat([wanted.speed[:, None], moved.speed_history[:, 1:]], dim=1),
    )


def draw_tasks(config: RunConfig, n: int, seed: int = 0) -> Task:
    return TaskSampler(config.scenario, MIXTURE, torch.Generator().manual_seed(seed)).draw(n)


def meet(config: RunConfig, game: Game, s: list[list[float]], speed: list[list[float]]) -> World:
    """Worlds with vehicles at `s` [E, V] (m) on their routes at `speed` [E, V] (m/s)."""
    world = game.simulator.reset(draw_tasks(config, len(s)))
    places, zero = torch.tensor(s), torch.zeros(len(s), len(s[0]))
    direction = world.task.direction
    route = RouteState(places, torch.tensor(speed), zero, *game.simulator.road.route_offset(places, direction))
    return place(world, game.simulator.road.to_world(route, direction))


def drive(game: Game, world: World, horizon: Tensor, n_steps: int) -> list[World]:
    """The worlds of every step; none after everyone has arrived."""
    worlds = [world]
    for _ in range(n_steps):
        world, _ = game.simulator.step(world, game.plan(game.perceive(world), horizon).state)
        worlds.append(world)
        if world.has_reached.all():
            break
    return worlds
