"""The game as a reinforcement-learning environment: batched worlds whose actions are prediction horizons."""

from typing import Protocol

import torch
from torch import Tensor

from negopipe.game.game import Game
from negopipe.game.reward import RewardConfig, reward
from negopipe.learning.rollout import Transition
from negopipe.simulation.state import EGO, NEAREST, Task, World
from negopipe.tensors.prefixes import add_prefix, strip_prefix
from negopipe.tensors.tree import map_tensors, named_tensors, with_tensors


class TaskSource(Protocol):
    """Source of the tasks of worlds: `TaskSampler` with one stream for all of them, or one with a stream for each."""

    def expect(self, n: int) -> None:
        """Hear at every step, before the draw, that `n` worlds want a task; 0 too, for those of other processes may."""
        ...

    def draw_for(self, worlds: Tensor) -> Task:
        """Draw the next tasks of the worlds [n] int64."""
        ...

    def get_state(self) -> Tensor:
        """State of all streams, uint8."""
        ...

    def set_state(self, state: Tensor) -> None:
        """Restore what `get_state` returned."""
        ...


class NegotiationEnv:
    """E worlds of one scenario; satisfies `negopipe.learning.rollout.Environment`.

    An agent's action is an index into `horizons_s`. The egos are agents, and with `learners` so are all V - 1 social
    vehicles: agent v E + e is vehicle v of world e. Social vehicles whose driver is one of the learners do what their
    actions say, all others drive by their tasks. A world whose episode is over starts a new task at once, drawn from
    `sampler`, which the curriculum replaces at stage ends.

    learners: drivers of the population, by index, whose decisions are those of the policy that learns
    """

    def __init__(
        self,
        game: Game,
        reward_config: RewardConfig,
        horizons_s: tuple[float, ...],
        sampler: TaskSource,
        n_worlds: int,
        learners: tuple[int, ...] = (),
    ) -> None:
        self.game, self.reward_config, self.sampler, self.n_worlds = game, reward_config, sampler, n_worlds
        device = game.planner.times.device
        self._horizons = torch.tensor(horizons_s, device=device)
        self._learners = torch.tensor(learners, dtype=torch.int64, device=device)
        self.n_actions = len(horizons_s)
        self.restart()

    def restart(self) -> None:
        """Start a new task in every world."""
        everyone = torch.arange(self.n_worlds, device=self._horizons.device)
        self.sampler.expect(self.n_worlds)
        self.world: World = self.game.simulator.reset(self.sampler.draw_for(everyone))
        self._observation = self._seen(self.world, self.game.see(self.world))

    def begin(self, tasks: Task, which: Tensor) -> None:
        """Start the tasks [n] in the worlds `which` [n] int64, whose places in the observations are overwritten."""
        started = self.game.simulator.reset(tasks)
        self.world = map_tensors(lambda field, new: field.index_copy(0, which, new), self.world, started)
        agents = (torch.arange(self._n_seats, device=which.device)[:, None] * self.n_worlds + which).flatten()
        self._observation.index_copy_(0, agents, self._seen(started, self.game.see(started)))

    def observe(self) -> Tensor:
        """[A, *obs]: the present observations of the agents; 0 for those that do not learn."""
        return self._observation

    def is_learning(self) -> Tensor:
        """[A] bool: egos, and social vehicles that a learner drives and that have not collided."""
        is_learning = self._drives_as_learner(self.world)
        is_learning[:, EGO] = True
        return is_learning[:, : self._n_seats].T.flatten()

    def step(self, action: Tensor) -> Transition:
        """Drive every vehicle for one control step; `action` [A] int64."""
        world, chosen = self.world, self._horizons[action].unflatten(0, (-1, self.n_worlds)).T  # [E, 1 or V]
        horizons = self.game.choose(world, chosen[:, EGO])
        if len(self._learners):
            horizons = torch.where(self._drives_as_learner(world), chosen, horizons)
        moved, events, *_ = self.game.drive(world, horizons)
        reached = self._seen(moved, self.game.see(moved))
        has_crashed = (moved.has_collided & ~world.has_collided)[:, : self._n_seats]
        has_crashed = has_crashed | events.is_collision[:, None]  # of the ego, which ends the episode for all
        is_terminated = (has_crashed | events.is_terminated[:, None]).T.flatten()
        is_truncated = events.is_truncated.repeat(self._n_seats) & ~is_terminated
        which = (events.is_terminated | events.is_truncated).nonzero()[:, 0]
        final = reached[is_terminated | is_truncated]
        self._start_again(moved, reached, which)
        is_success = events.is_success[:, None].expand_as(has_crashed)
        return Transition(
            observation=self._observation,
            final_observation=final,
            reward=reward(self.reward_config, has_crashed.T.flatten(), is_success.T.flatten()),
            is_terminated=is_terminated,
            is_truncated=is_truncated,
            is_success=events.is_success,
            is_collision=events.is_collision,
            final_info={
                "social_start_distance_m": world.task.start_distance[which, NEAREST],
                "style_horizon_s": world.task.style_horizon[which, NEAREST],
                "social_driver": world.task.casting.driver[which, NEAREST],
                "street": world.task.direction[which, EGO].abs().long(),
            },
        )

    def state_dict(self) -> dict[str, Tensor]:
        """State on which the next step depends: the worlds, their observations and the stream of tasks."""
        seen, tasks = self._observation, self.sampler.get_state()
        return {**add_prefix("world", named_tensors(self.world)), "observation": seen, "tasks": tasks}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned; the sampler's families are not part of it."""
        self.world = with_tensors(self.world, strip_prefix("world", state))
        self._observation = state["observation"].to(self._observation.device)
        self.sampler.set_state(state["tasks"])

    @property
    def _n_seats(self) -> int:
        """Vehicles of a world that are agents."""
        return self.world.task.direction.shape[1] if len(self._learners) else 1

    def _drives_as_learner(self, world: World) -> Tensor:
        """[E, V] bool: a learner drives the social vehicle, which takes part and has not collided."""
        return torch.isin(world.task.casting.driver, self._learners) & ~world.has_collided & world.task.is_present

    def _seen(self, world: World, by_egos: Tensor) -> Tensor:
        """[A, *obs]: observations of all agents of E worlds, from those of the egos [E, *obs]."""
        if not len(self._learners):
            return by_egos
        n_worlds = len(by_egos)
        others = by_egos.new_zeros((self._n_seats - 1) * n_worlds, *by_egos.shape[1:])
        row, vehicle = self._drives_as_learner(world).nonzero().unbind(1)
        if len(row):
            part = map_tensors(lambda field: field.index_select(0, row), world)
            others.index_copy_(0, (vehicle - 1) * n_worlds + row, self.game.see_as(part, vehicle))
        return torch.cat([by_egos, others])

    def _start_again(self, moved: World, reached: Tensor, which: Tensor) -> None:
        """Continue from `moved`, with observations `reached` [A, *obs], and with new tasks in the worlds `which`."""
        self.world, self._observation = moved, reached
        self.sampler.expect(len(which))
        if len(which):
            self.begin(self.sampler.draw_for(which), which)
