"""Batched worlds as other people's code meets them: streams of tasks of their own, metrics, pictures, copies."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.envs.episode_record import EpisodeRecord, Shot, metrics
from negopipe.envs.given_task import given_task
from negopipe.envs.overrides import in_one_line
from negopipe.envs.own_streams import OwnStreams
from negopipe.errors import UserError
from negopipe.game.environment import NegotiationEnv
from negopipe.game.game import Driven, Game, build_game
from negopipe.learning.rollout import Transition
from negopipe.observation.objects import ObjectsConfig
from negopipe.observation.occupancy_grid import OccupancyGridConfig
from negopipe.runtime.build import with_learned
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import World
from negopipe.tensors.torch_settings import own_settings

OCCUPIED = 255
"""Value of an occupied cell in an observation."""
MOST = 2**62
"""Upper bound of the numbers that streams of tasks are seeded with."""


class EpisodeEnd(NamedTuple):
    """End of an episode: what gymnasium's `info` holds of it, and its last moment."""

    info: dict[str, Any]
    shot: Shot


class Worlds:
    """E worlds of a config, whose episodes depend on the config, the seed of each and the actions only.

    Worlds are computed in one thread on the CPU. Copies and pickles hold the whole state and continue from it.
    is_self_play: every vehicle is an agent, else the ego is the only one; a population of one driver `self`
    ended: the episodes that the latest step ended, by world; new ones have begun there
    """

    def __init__(self, config: RunConfig, n_worlds: int, is_self_play: bool = False) -> None:
        self.config, self.n_worlds, self.is_self_play = config, n_worlds, is_self_play
        self._set_up()
        self.record = EpisodeRecord(self._game, n_worlds)
        self.ended: dict[int, EpisodeEnd] = {}

    def _set_up(self) -> None:
        config = self.config
        self._game = with_learned(build_game(config), config, None)
        scenario, assign = config.scenario, self._game.cast.assign
        sampler = TaskSampler(scenario, config.evaluated_families, torch.Generator(), assign, scenario.training_streets)
        self._streams = OwnStreams(sampler, self.n_worlds)
        learners = self._game.cast.learners if self.is_self_play else ()
        game = replace(self._game, drive=self._drive)
        self._env = NegotiationEnv(
            game, config.reward, config.policy.horizons_s, self._streams, self.n_worlds, learners
        )

    def _drive(self, world: World, horizon: Tensor) -> Driven:
        """`Game.drive`, which is kept for the record."""
        self._driven = self._game.drive(world, horizon)
        return self._driven

    @property
    def game(self) -> Game:
        return self._game

    def spaces(self) -> tuple[Box, Discrete]:
        """Observation and action space of one agent, new ones at every call."""
        shown, actions = self.config.observation, Discrete(self._env.n_actions)
        match shown:
            case OccupancyGridConfig():
                return Box(0, OCCUPIED, shown.shape, np.uint8), actions
            case ObjectsConfig():
                return Box(-shown.scales.largest, shown.scales.largest, shown.shape, np.float32), actions

    @own_settings()
    def restart(self, which: Sequence[int], seeds: Sequence[int | None], task: Any = None) -> None:
        """Start the next task in the worlds `which`, of new streams where they have seeds.

        task: values of the tasks that are not drawn, see `given_task`; None = all are drawn
        """
        for world, seed in zip(which, seeds, strict=True):
            if seed is not None:
                self._streams.seed(world, seed)
        worlds = torch.tensor(which)
        tasks = self._streams.draw_for(worlds)
        if task is not None:
            tasks = given_task(tasks, task, self._game, self.config)
        self._env.begin(tasks, worlds)
        self.record.start(self._game, self._env.world, worlds.numpy())
        self.ended = {}

    def begin_next(self, seed: int | None, task: Any) -> None:
        """Start the next task of a single world, which is already there where the last step ended an episode.

        seed, task: as for `restart`
        """
        if seed is not None or task is not None or not self.ended:
            self.restart([0], [seed], task)
        self.ended = {}

    @own_settings()
    def observe(self) -> np.ndarray:
        """[A, *obs]: the observations of all agents, agent v E + e is vehicle v of world e."""
        return shown(self._env.observe())

    def is_driving(self) -> np.ndarray:
        """[A] bool: the agents whose vehicle has not collided."""
        return self._env.is_learning().numpy()

    @own_settings()
    def step(self, action: Any) -> Transition:
        """Transition by the actions [A]; UserError if they are no actions."""
        given, n_actions, n = np.asarray(action), self._env.n_actions, len(self._env.observe())
        has_shape = given.shape == (n,) or given.size == n == 1
        if not (has_shape and given.dtype.kind in "iu" and (given >= 0).all() and (given < n_actions).all()):
            what = "an integer" if n == 1 else f"{n} integers"
            raise UserError(f"action must be {what} from 0 to {n_actions - 1}, got {in_one_line(action)}")
        reached = self._env.step(torch.tensor(given.reshape(-1).astype(np.int64)))
        driven, of_egos = self._driven, slice(self.n_worlds)
        rows = {"intervention": driven.intervention.numpy(), "reward": reached.reward[of_egos].numpy()}
        self.record.add(self._game, driven.world, driven.motion, rows)
        is_over = driven.events.is_terminated | driven.events.is_truncated
        which = is_over.nonzero()[:, 0].numpy()
        self.ended = {world: self._end(world) for world in which.tolist()}
        if len(which):
            self.record.start(self._game, self._env.world, which)
        return reached

    def _end(self, world: int) -> EpisodeEnd:
        moved, events, *_ = self._driven
        outcome = self.record.outcome(self._game, moved, events, world)
        limits, plan_s = self.config.planner.limits, self.config.planner.horizon_s
        values = metrics(self.record.trace(world, outcome), limits.full_braking_mps2, plan_s)
        is_success, is_collision = bool(events.is_success[world]), bool(events.is_collision[world])
        info = {"is_success": is_success, "is_collision": is_collision, **values}
        return EpisodeEnd(info, self.record.shot(world, outcome))

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in self.__dict__.items() if not name.startswith("_")}
        return kept | {"_tensors": {name: tensor.numpy() for name, tensor in self._env.state_dict().items()}}

    @own_settings()
    def __setstate__(self, state: dict[str, Any]) -> None:
        tensors = state.pop("_tensors")
        self.__dict__ |= state
        self._set_up()  # functions cannot be pickled
        self._env.load_state_dict({name: torch.tensor(array) for name, array in tensors.items()})


def shown(observation: Tensor) -> np.ndarray:
    """Grids of 0 and 255 from grids of 0 and 1; rows of numbers are shown as they are, copied."""
    return observation.numpy() * (OCCUPIED if observation.dtype == torch.uint8 else 1)  # NumPy starts no threads
