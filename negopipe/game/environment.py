"""The game as a reinforcement-learning environment: batched worlds that pick a prediction horizon and drive on."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from negopipe import environment
from negopipe.game.reward import RewardConfig, reward
from negopipe.learning.rollout import Transition
from negopipe.observation.occupancy_grid import ObservationConfig, OccupancyGrid, history_steps
from negopipe.planner.frenet import FrenetPlanner, PlannerConfig
from negopipe.simulation.dynamics import DynamicsConfig, build_dynamics
from negopipe.simulation.perception import Perception, PerceptionConfig, Sensor
from negopipe.simulation.scenario import ScenarioConfig, TaskSampler
from negopipe.simulation.simulator import Events, Simulator
from negopipe.simulation.state import (
    EGO,
    NEAREST,
    Motion,
    VehicleState,
    World,
    map_tensors,
    named_tensors,
    tree_where,
    with_tensors,
)
from negopipe.tensors.chunked import ChunkedFunction
from negopipe.tensors.prefixes import add_prefix, strip_prefix

CHUNKS = {"cpu": 64, "cuda": 1024}
"""Worlds that are computed at once: large enough for the cost of a call; on a CPU small enough for the cache."""


class GameConfig(Protocol):
    """What a game depends on; `negopipe.config.root.RunConfig` has it all."""

    @property
    def scenario(self) -> ScenarioConfig: ...

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
    """The parts that make one decision, each a function of tensors; compiled or not, they are called alike.

    All take any number of worlds.

    simulator: resets worlds and knows the road
    planner: what `plan` belongs to
    plan: Perception, horizon [E, S] (s) -> Motion [E, S]
    perceive: World -> Perception of all vehicles
    step: World, VehicleState [E, V] -> World, Events
    draw: Perception of one agent -> [E, F, H, W] uint8 grids
    drive: World, horizon [E, V] (s) -> World, Events: perceive, plan and step as one, for all vehicles
    advance: like `drive`, and what the ego sees then
    see: World -> [E, F, H, W] uint8 grids of the ego: perceive and draw as one
    observation_shape: (F, H, W)
    """

    simulator: Simulator
    planner: FrenetPlanner
    plan: Callable[[Perception, Tensor], Motion]
    perceive: Callable[[World], Perception]
    step: Callable[[World, VehicleState], tuple[World, Events]]
    draw: Callable[[Perception], Tensor]
    drive: Callable[[World, Tensor], tuple[World, Events]]
    advance: Callable[[World, Tensor], tuple[World, Events, Tensor]]
    see: Callable[[World], Tensor]
    observation_shape: tuple[int, int, int]


def build_game(config: GameConfig, device: torch.device | str = "cpu", is_compiled: bool = False) -> Game:
    """Everything that depends on the configuration but not on a task."""
    scenario, observation = config.scenario, config.observation
    sensor = Sensor(config.perception, scenario.dt_s, history_steps(observation, scenario.dt_s))
    simulator = Simulator(scenario, sensor.memory_steps, build_dynamics(config.dynamics, scenario.dt_s), device)
    frenet = FrenetPlanner(config.planner, simulator.road, scenario.vehicle, scenario.dt_s, device)
    grid = OccupancyGrid(observation, simulator.road, scenario.vehicle, scenario.dt_s, device)
    size = CHUNKS[torch.device(device).type]

    def drive(world: World, horizon: Tensor) -> tuple[World, Events]:
        return simulator.step(world, frenet.plan(sensor.perceive(world), horizon).state)

    def advance(world: World, horizon: Tensor) -> tuple[World, Events, Tensor]:
        moved, events = drive(world, horizon)
        return moved, events, see(moved)

    def see(world: World) -> Tensor:
        return grid.draw(sensor.perceive(world).of(EGO))

    def accelerate(fn: Callable) -> Callable:
        return ChunkedFunction(fn, size, _compile if is_compiled else None)

    return Game(
        simulator=simulator,
        planner=frenet,
        plan=accelerate(frenet.plan),
        perceive=sensor.perceive,
        step=accelerate(simulator.step),
        draw=accelerate(grid.draw),
        drive=accelerate(drive),
        advance=accelerate(advance),
        see=accelerate(see),
        observation_shape=grid.shape,
    )


def _compile(fn: Callable) -> Callable:
    """Without guards, which cost as much as a tenth of the work: `ChunkedFunction` keeps shapes and dtypes, and nothing
    that a game is made of ever changes. Compiled code belongs to a code object; so that nobody else's is taken without
    guards to tell, every function gets one of its own. In one thread: a chunk is too small to gain from more.
    """
    fn.__code__ = fn.__code__.replace()
    no_guards = torch.compiler.skip_all_guards_unsafe
    return torch.compile(fn, dynamic=False, options={"guard_filter_fn": no_guards, "cpp.threads": 1})


def has_compiler() -> bool:
    """A C++ compiler is found, which torch.compile needs on the CPU: that of the variable CXX, if it names one."""
    named = environment.variable("CXX")
    return any(shutil.which(name) for name in ([named] if named else ["g++", "clang++"]))


class NegotiationEnv:
    """E worlds of one scenario; satisfies `negopipe.learning.rollout.Environment`.

    The action of the ego is an index into `horizons_s`; social vehicles drive in the style of their task. A world
    whose episode is over starts a new task at once, drawn from `sampler`, which may be replaced at any time
    (the curriculum does).
    """

    def __init__(
        self,
        game: Game,
        reward_config: RewardConfig,
        horizons_s: tuple[float, ...],
        sampler: TaskSampler,
        n_worlds: int,
    ) -> None:
        self.game, self.reward_config, self.sampler, self.n_worlds = game, reward_config, sampler, n_worlds
        self.restart()
        self._horizons = torch.tensor(horizons_s, device=self.world.step.device)
        self.n_actions = len(horizons_s)

    def restart(self, is_chosen: Tensor | None = None) -> None:
        """Start a new task in every world; only in the chosen ones [E] bool, which get the tasks that they would get
        among all."""
        started = self.game.simulator.reset(self.sampler.draw(self.n_worlds))
        self.world: World = started if is_chosen is None else tree_where(is_chosen, started, self.world)
        self._observation = self.game.see(self.world)

    def observe(self) -> Tensor:
        """[E, F, H, W] uint8, 0 or 1: the grids that the ego sees now."""
        return self._observation

    def step(self, action: Tensor) -> Transition:
        """Drive every vehicle for one control step; `action` [E] int64 is the ego's."""
        world = self.world
        horizon = world.style_horizon.clone()
        horizon[:, EGO] = self._horizons[action]
        moved, events, reached = self.game.advance(world, horizon)
        which = (events.is_terminated | events.is_truncated).nonzero()[:, 0]
        final = self._start_again(moved, reached, which)
        return Transition(
            observation=self._observation,
            final_observation=final,
            reward=reward(self.reward_config, events.is_collision, events.is_success),
            is_terminated=events.is_terminated,
            is_truncated=events.is_truncated,
            is_success=events.is_success,
            is_collision=events.is_collision,
            final_info={
                "social_start_distance_m": world.task.start_distance[which, NEAREST],
                "style_horizon_s": world.task.style_horizon[which, NEAREST],
            },
        )

    def state_dict(self) -> dict[str, Tensor]:
        """All that the next step depends on: the worlds, what is seen of them and the stream of tasks."""
        seen, tasks = self._observation, self.sampler.generator.get_state()
        return {**add_prefix("world", named_tensors(self.world)), "observation": seen, "tasks": tasks}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on where `state_dict` was taken; the sampler's families are not part of it."""
        self.world = with_tensors(self.world, strip_prefix("world", state))
        self._observation = state["observation"].to(self._observation.device)
        self.sampler.generator.set_state(state["tasks"])

    def _start_again(self, moved: World, reached: Tensor, which: Tensor) -> Tensor:
        """Go on from `moved`, seeing `reached` [E, F, H, W], with new tasks in the D worlds `which`.

        Returns what was seen last in those, [D, F, H, W].
        """
        self.world, self._observation = moved, reached
        final = reached[which]
        if len(which) > 0:
            started = self.game.simulator.reset(self.sampler.draw(len(which)))
            self.world = map_tensors(lambda field, new: field.index_copy(0, which, new), moved, started)
            reached.index_copy_(0, which, self.game.see(started))
        return final
