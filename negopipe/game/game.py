"""The game: the parts of one decision, built once for a configuration."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from negopipe import environment
from negopipe.agents.population import Cast, PopulationConfig
from negopipe.observation.occupancy_grid import ObservationConfig, OccupancyGrid, history_steps
from negopipe.planner.config import PlannerConfig
from negopipe.planner.frenet import FrenetPlanner
from negopipe.simulation.build_road import build_road
from negopipe.simulation.dynamics import DynamicsConfig, build_dynamics
from negopipe.simulation.perception import Perception, PerceptionConfig, Sensor
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.simulator import Events, Simulator
from negopipe.simulation.state import EGO, Motion, VehicleState, World
from negopipe.tensors.chunked import ChunkedFunction

CHUNKS = {"cpu": 64, "cuda": 1024}
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
    def observation(self) -> ObservationConfig: ...

    @property
    def perception(self) -> PerceptionConfig: ...

    @property
    def dynamics(self) -> DynamicsConfig: ...


@dataclass(frozen=True)
class Game:
    """The parts of one decision, each a function of tensors, eager or compiled, for any number of worlds.

    simulator: resets worlds and knows the road
    planner: the planner of `plan`
    cast: the drivers of the social vehicles
    choose: World, horizon of the ego [E] (s) -> horizons [E, V] (s) of all vehicles
    plan: Perception, horizon [E, S] (s) -> Motion [E, S], by the planner, or by the rule of an agent's driver
    perceive: World -> Perception of all vehicles
    step: World, VehicleState [E, V] -> World, Events
    draw: Perception of one agent -> [E, F, H, W] uint8 grids
    drive: World, horizon [E, V] (s) -> World, Events: perceive, plan and step in one call, for all vehicles
    advance: World, horizon [E, V] (s) -> World, Events, grids of the ego: `drive` and `see` in one call
    see: World -> [E, F, H, W] uint8 grids of the ego: perceive and draw in one call
    see_as: World, vehicle [E] int64 -> [E, F, H, W] uint8 grids of that vehicle
    observation_shape: (F, H, W)
    """

    simulator: Simulator
    planner: FrenetPlanner
    cast: Cast
    choose: Callable[[World, Tensor], Tensor]
    plan: Callable[[Perception, Tensor], Motion]
    perceive: Callable[[World], Perception]
    step: Callable[[World, VehicleState], tuple[World, Events]]
    draw: Callable[[Perception], Tensor]
    drive: Callable[[World, Tensor], tuple[World, Events]]
    advance: Callable[[World, Tensor], tuple[World, Events, Tensor]]
    see: Callable[[World], Tensor]
    see_as: Callable[[World, Tensor], Tensor]
    observation_shape: tuple[int, int, int]


def build_game(config: GameConfig, device: torch.device | str = "cpu", is_compiled: bool = False) -> Game:
    """The game of a configuration; nothing in it depends on a task."""
    scenario, observation = config.scenario, config.observation
    sensor = Sensor(
        config.perception,
        build_road(scenario, device),
        scenario.dt_s,
        history_steps(observation, scenario.dt_s),
        config.population.is_attentive,
        config.planner.lowest_speed_mps,
    )
    simulator = Simulator(scenario, sensor, build_dynamics(config.dynamics, scenario.dt_s), device)
    frenet = FrenetPlanner(config.planner, simulator.road, scenario.sizes, scenario.dt_s, device)
    cast = Cast(config.population, simulator)
    grid = OccupancyGrid(observation, simulator.road, scenario.sizes, scenario.dt_s, device)
    size = CHUNKS[torch.device(device).type]

    def plan(perception: Perception, horizon: Tensor) -> Motion:
        return cast.drive(perception, horizon, frenet.plan)

    def drive(world: World, horizon: Tensor) -> tuple[World, Events]:
        return simulator.step(world, plan(sensor.perceive(world), horizon).state)

    def advance(world: World, horizon: Tensor) -> tuple[World, Events, Tensor]:
        moved, events = drive(world, horizon)
        return moved, events, see(moved)

    def see(world: World) -> Tensor:
        return grid.draw(sensor.perceive(world).of(EGO))

    def see_as(world: World, vehicle: Tensor) -> Tensor:
        return grid.draw(sensor.perceive(world).of_each(vehicle))

    def accelerate(fn: Callable) -> Callable:
        return ChunkedFunction(fn, size, _compile if is_compiled else None)

    return Game(
        simulator=simulator,
        planner=frenet,
        cast=cast,
        choose=World.horizons,
        plan=accelerate(plan),
        perceive=sensor.perceive,
        step=accelerate(simulator.step),
        draw=accelerate(grid.draw),
        drive=accelerate(drive),
        advance=accelerate(advance),
        see=accelerate(see),
        see_as=accelerate(see_as),
        observation_shape=grid.shape,
    )


def _compile(fn: Callable) -> Callable:
    """`fn` compiled without guards and for one thread.

    Guards cost as much as a tenth of the work. They are not needed: `ChunkedFunction` keeps shapes and dtypes, and the
    parts of a game never change. Compiled code belongs to a code object, and without guards a function could be given
    the code of another one, so every function gets a code object of its own. A chunk is too small for more threads.
    """
    fn.__code__ = fn.__code__.replace()
    no_guards = torch.compiler.skip_all_guards_unsafe
    return torch.compile(fn, dynamic=False, options={"guard_filter_fn": no_guards, "cpp.threads": 1})


def has_compiler() -> bool:
    """Whether there is a C++ compiler, which torch.compile needs on the CPU: that of the variable CXX, if it is set."""
    named = environment.variable("CXX")
    return any(shutil.which(name) for name in ([named] if named else ["g++", "clang++"]))
