"""The runtime in the simulator: an exported decision computed by torch, messages made of worlds, closed loops."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from games import draw_tasks, tiny_config
from torch import Tensor

from negopipe.agents.horizon_drivers import drawn_action
from negopipe.config.root import RunConfig, as_mapping
from negopipe.deployment import EgoState, HostStreet, Negotiator, ObjectState, Trajectory
from negopipe.deployment.decision import Decision, outputs
from negopipe.deployment.decision_file import street_of, tensors_of
from negopipe.deployment.policy_file import exported
from negopipe.deployment.settings import Settings
from negopipe.deployment.surroundings import NAMES, Surroundings
from negopipe.game.game import Game, build_game
from negopipe.policy.actor_critic import Policy, greedy_action
from negopipe.runtime.build import load_policy
from negopipe.simulation.state import EGO, VehicleState, World
from negopipe.tracking.checkpoint import find_checkpoint

Arrays = Mapping[str, np.ndarray]
Lossy = Callable[[float, list[ObjectState]], list[ObjectState] | None]
"""Time and the messages that are true then -> what reaches the runtime."""

ORIGIN, HEADING = np.array([300.0, -40.0]), 2.5
"""Where the host's map has the corridor's middle, and the line's heading there."""


GENERALIST = (
    "checkpoint=pretrained/generalist",
    "observation=objects",
    "policy=objects",
    "planner=reversing",
    "policy.horizons_s=[0.0,2.0,4.0,6.0,inf]",
    "perception.range_m=60.0",
)
"""Overrides for the policy that learnt many streets."""


@cache
def parts(*overrides: str) -> tuple[RunConfig, Game, Policy]:
    """Config, game and a policy that comes with negopipe."""
    precision = () if "policy=objects" in overrides else ("policy.precision=float32",)
    config = tiny_config("yield", *precision, *overrides)
    policy = exported(load_policy(find_checkpoint(config.checkpoint or "pretrained/yield", config), config))
    return config, build_game(config), policy


def negotiator(*overrides: str, seed: int = 0) -> Negotiator:
    """The runtime with torch in the place of onnxruntime, on the same graph."""
    config, _, policy = parts(*overrides)
    decision, surroundings = Decision(config, policy).eval(), Surroundings(config)

    @torch.no_grad()
    def decide(arguments: Arrays) -> Arrays:
        found = decision(**tensors_of(config, arguments))
        return {name: each.numpy() for name, each in zip(outputs(config), found, strict=True)}

    @torch.no_grad()
    def surround(tables: Arrays) -> Arrays:
        found = surroundings({name: torch.from_numpy(np.array(table)) for name, table in tables.items()})
        return {name: each.numpy() for name, each in zip(NAMES, found, strict=True)}

    return Negotiator(Settings.of(as_mapping(config)), decide, surround, seed)


def straight_on(arguments: Arrays) -> Arrays:
    """A decision that stands for the exported one: 6 s straight on at the present speed."""
    x, y, yaw, speed, *_ = arguments["own"].tolist()
    driven = speed * 0.2 * np.arange(1, 31)
    columns = [x + driven * math.cos(yaw), y + driven * math.sin(yaw), *(np.full(30, each) for each in (yaw, speed))]
    trajectory = np.stack([*columns, np.zeros(30), np.zeros(30)], -1)
    plan = {"trajectory": trajectory, "horizon": np.array([4.0]), "is_full_braking": np.array([False])}
    return plan | {"logits": np.log([[0.1, 0.2, 0.6, 0.1]])}


def street_for(runtime: Negotiator, game: Game, world: World) -> HostStreet:
    """The street of a world, somewhere on the host's map."""
    direction = float(world.task.direction[0, EGO])
    street = street_of(game.simulator.road, round(abs(direction)))
    return runtime.street(street, float(np.sign(direction)), ORIGIN, HEADING)


def messages(world: World, street: HostStreet, time_s: float) -> tuple[EgoState, list[ObjectState]]:
    """What sensors say of the first world."""
    vehicles, task = world.vehicles, world.task
    columns = [vehicles.position[0], *(f[0, :, None] for f in (vehicles.yaw, vehicles.speed, vehicles.accel))]
    columns.append(vehicles.curvature[0, :, None])
    rows = street.to_host(torch.cat(columns, -1).double().numpy()).tolist()
    ego = EgoState(time_s, *rows[EGO], float(task.desired_speed[0, EGO]))
    others = [
        ObjectState(f"car {index}", time_s, *row[:4], float(task.length[0, index]), float(task.width[0, index]))
        for index, row in enumerate(rows)
        if index != EGO
    ]
    return ego, others


def first_state(trajectory: Trajectory, street: HostStreet) -> VehicleState:
    """The state that the trajectory leads to one control step later, [1]."""
    x, y, yaw, speed, accel, curvature = street.to_street(trajectory.states[1]).tolist()
    one = torch.tensor([yaw, speed, accel, curvature])[:, None]
    return VehicleState(torch.tensor([[x, y]]), *one)


def wanted_by(game: Game, world: World, ego: VehicleState | None, horizon: Tensor) -> VehicleState:
    """What all vehicles of the first world drive; ego: None = as the simulator's planner does."""
    wanted = game.plan(game.perceive(world), game.choose(world, horizon)).state
    if ego is None:
        return wanted
    fields = {name: getattr(wanted, name).clone() for name in vars(wanted)}
    for name, field in fields.items():
        field[0, EGO] = getattr(ego, name)[0]
    return replace(wanted, **fields)


def drive_with_runtime(
    runtime: Negotiator, n_steps: int, *overrides: str, seed: int, lossy: Lossy = lambda _, sent: sent
) -> tuple[list[World], list[Trajectory]]:
    """A closed loop of one task through messages: worlds, and what the runtime said in each."""
    config, game, _ = parts(*overrides)
    world = game.simulator.reset(draw_tasks(config, 1, seed))
    street = street_for(runtime, game, world)
    worlds, said = [world], []
    for step in range(n_steps):
        time_s = 1000.0 + step * config.scenario.dt_s
        ego, others = messages(world, street, time_s)
        said.append(runtime.decide(ego, lossy(time_s, others), street, time_s))
        wanted = wanted_by(game, world, first_state(said[-1], street), torch.tensor([torch.nan]))
        world, events = game.simulator.step(world, wanted)
        worlds.append(world)
        if bool((events.is_terminated | events.is_truncated)[0]):
            break
    return worlds, said


@torch.no_grad()
def drive_in_simulator(n_steps: int, *overrides: str, seed: int) -> list[World]:
    """The same task, the ego driven by the same policy in the simulator, as an evaluation does it."""
    config, game, policy = parts(*overrides)
    horizons = torch.tensor(config.policy.horizons_s)
    world = game.simulator.reset(draw_tasks(config, 1, seed))
    worlds = [world]
    for _ in range(n_steps):
        logits = policy(game.see(world))[0]
        is_drawn = config.evaluation.action == "sample"
        action = drawn_action(logits, world.task.noise_seed, world.step) if is_drawn else greedy_action(logits)
        horizon = horizons[action]
        world, events, *_ = game.drive(world, game.choose(world, horizon))
        worlds.append(world)
        if bool((events.is_terminated | events.is_truncated)[0]):
            break
    return worlds


def places(worlds: Iterable[World]) -> np.ndarray:
    """[T, V, 2] m, of the vehicles of the first world."""
    return torch.stack([world.vehicles.position[0] for world in worlds]).numpy()
