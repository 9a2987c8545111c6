"""The game: the parts of one decision, built once for a configuration."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from negopipe import environment
from negopipe.agents.population import Cast, PopulationConfig
from negopipe.game.guard import Guard, n_kept
from negopipe.observation.kinds import AnyObservationConfig, Observation, build_observation
from negopipe.planner.config import PlannerConfig
from negopipe.planner.frenet import FrenetPlanner
from negopipe.safety.config import SafetyConfig
from negopipe.simulation.build_road import build_road
from negopipe.simulation.dynamics import DynamicsConfig, build_dynamics
from negopipe.simulation.perception import Perception, PerceptionConfig, Sensor
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.simulator import Events, Simulator
from negopipe.simulation.state import EGO, Motion, World
from negopipe.tensors.chunked import ChunkedFunction
from negopipe.tensors.compiled import compiled
from negopipe.tensors.cuda_graph import GraphedFunction

CHUNKS = {"cpu": [64], "cuda": [64, 512, 4096]}
"""Worlds per call: many enough to outweigh the cost of a call, on a CPU few enough to stay in the cache."""


class GameConfig(Protocol):
    """The parts of a configuration that make a game; `negopipe.config.root.RunConfig` has them."""

    @property
    def scenario(self) -> ScenarioConfig: ...

    @property
    def population(self) -> PopulationConfig: ...

    @property
    def planner(self) -> PlannerConfig: ...

    @property
    def observation(self) -> AnyObservationConfig: ...

    @property
    def perception(self) -> PerceptionConfig: ...

    @property
    def dynamics(self) -> DynamicsConfig: ...

    @property
    def safety(self) -> SafetyConfig: ...


class Driven(NamedTuple):
    """A decision of E worlds and what it led to.

    world: World, one control step later
    events: Events of the step
    motion: Motion [E, V] of all vehicles
    intervention: [E] int64, of the safety layer
    """

    world: World
    events: Events
    motion: Motion
    intervention: Tensor


@dataclass(frozen=True)
class Game:
    """The parts of one decision, each a function of tensors, eager or compiled, for any number of worlds.

    Most decisions are made by `drive`. `guard` and `step` are for the few drivers that move by a rule of their own.
    They are not compiled, since that takes longer than what those drive.

    simulator: resets worlds and knows the road
    planner: the planner of `plan`
    cast: the drivers of the social vehicles
    choose: World, horizon of the ego [E] (s) -> horizons [E, V] (s) of all vehicles
    plan: Perception, horizon [E, S] (s) -> Motion [E, S], by the planner, or by the rule of an agent's driver
    perceive: World -> Perception of all vehicles
    guard: World, Perception, Motion [E, V] -> the same with what the safety layer lets the ego drive, and the layer's
        interventions [E] int64 (`negopipe.safety.layer`)
    step: World, Motion [E, V] -> World, Events
    draw: Perception of one agent -> observations [E, *obs]
    drive: World, horizon [E, V] (s) -> Driven: perceive, plan, guard and step in one call, for all vehicles
    see: World -> observations of the ego [E, *obs]: perceive and draw in one call
    see_as: World, vehicle [E] int64 -> observations of that vehicle [E, *obs]
    watch: another kind of observation -> a function as `see_as` with it
    observation_shape: shape of one observation, *obs
    """

    simulator: Simulator
    planner: FrenetPlanner
    cast: Cast
    choose: Callable[[World, Tensor], Tensor]
    plan: Callable[[Perception, Tensor], Motion]
    perceive: Callable[[World], Perception]
    guard: Callable[[World, Perception, Motion], tuple[World, Motion, Tensor]]
    step: Callable[[World, Motion], tuple[World, Events]]
    draw: Callable[[Perception], Tensor]
    drive: Callable[[World, Tensor], Driven]
    see: Callable[[World], Tensor]
    see_as: Callable[[World, Tensor], Tensor]
    watch: Callable[[Observation], Callable[[World, Tensor], Tensor]]
    observation_shape: tuple[int, ...]


def build_game(config: GameConfig, device: torch.device | str = "cpu", is_compiled: bool = False) -> Game:
    """The game of a configuration; nothing in it depends on a task."""
    scenario, sensor = config.scenario, _sensor(config, device)
    simulator = _simulator(config, sensor, device)
    guard = Guard(config.safety, simulator)
    frenet = FrenetPlanner(config.planner, simulator.road, scenario.sizes, scenario.dt_s, device)
    cast = Cast(config.population, simulator)
    observation = build_observation(config.observation, simulator)
    accelerate = _accelerator(torch.device(device).type, is_compiled)

    def plan(perception: Perception, horizon: Tensor) -> Motion:
        return guard.decided(perception, cast.drive(perception, horizon, frenet.plan))

    def step(world: World, motion: Motion) -> tuple[World, Events]:
        moved, events = simulator.step(world, motion.state)
        return replace(moved, last_horizon=motion.horizon), events

    def drive(world: World, horizon: Tensor) -> Driven:
        perception = sensor.perceive(world)
        world, motion, intervention = guard.guard(world, perception, plan(perception, horizon))
        return Driven(*step(world, motion), motion, intervention)

    def watch(shown: Observation) -> Callable[[World, Tensor], Tensor]:
        return accelerate(lambda world, vehicle: shown.draw(sensor.perceive(world).of_each(vehicle)))

    see_as = watch(observation)

    return Game(
        simulator=simulator,
        planner=frenet,
        cast=cast,
        choose=World.horizons,
        plan=accelerate(plan),
        perceive=sensor.perceive,
        guard=guard.guard,
        step=step,
        draw=accelerate(observation.draw),
        drive=accelerate(drive),
        see=lambda world: see_as(world, torch.full_like(world.step, EGO)),  # one function to compile less
        see_as=see_as,
        watch=watch,
        observation_shape=observation.shape,
    )


def _accelerator(kind: str, is_compiled: bool) -> Callable[[Callable], Callable]:
    """Functions of worlds, in chunks on a kind of device, compiled or not."""
    compilers: dict[str, Callable[[Callable], Callable]] = {"cpu": compiled, "cuda": GraphedFunction}
    compiler = compilers[kind] if is_compiled else None
    return lambda fn: ChunkedFunction(fn, CHUNKS[kind], compiler)


def _simulator(config: GameConfig, sensor: Sensor, device: torch.device | str) -> Simulator:
    dynamics = build_dynamics(config.dynamics, config.scenario.dt_s)
    return Simulator(config.scenario, sensor, dynamics, device, n_kept(config.safety))


def _sensor(config: GameConfig, device: torch.device | str) -> Sensor:
    """The sensor of every vehicle, which remembers as much as the observation shows."""
    dt_s = config.scenario.dt_s
    return Sensor(
        config.perception,
        build_road(config.scenario, device),
        dt_s,
        config.observation.history_steps(dt_s),
        config.population.is_attentive,
        config.planner.lowest_speed_mps,
    )


def has_compiler() -> bool:
    """Whether there is a C++ compiler, which torch.compile needs on the CPU: that of the variable CXX, if it is set."""
    named = environment.variable("CXX")
    return any(shutil.which(name) for name in ([named] if named else ["g++", "clang++"]))
