"""Arenas: an opponent on a street, composed and built, in which encounters are driven."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from negopipe.agents.driver import Driver, HorizonDriver
from negopipe.agents.horizon_drivers import drawn_action
from negopipe.agents.person import PERSON, seat_person
from negopipe.config.compose import compose_config
from negopipe.errors import UserError, abbreviate
from negopipe.game.game import Game, build_game
from negopipe.policy.actor_critic import Policy, greedy_action
from negopipe.runtime.build import load_policy, with_learned
from negopipe.simulation.perception import Perception
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import Task
from negopipe.tensors.torch_settings import one_thread

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

COMPUTED = ("device=cpu", "compile='off'", "n_threads=1", "stages=[evaluate]")
"""Overrides that come last: one world at a time, without a compiler, and no stage that has conditions of its own."""


@dataclass(frozen=True)
class Arena:
    """An opponent on a street.

    opponent, street: names in `play.opponents` and `play.streets`
    policy: of the ego; None where a baseline or a second person drives it
    """

    opponent: str
    street: str
    config: "RunConfig"
    game: Game
    policy: Policy | None

    @property
    def baseline(self) -> str | None:
        return self.config.play.opponents[self.opponent].baseline

    @property
    def has_second_person(self) -> bool:
        """Whether a second person drives the ego."""
        return self.baseline == PERSON

    @property
    def horizons_s(self) -> tuple[float, ...]:
        """Those that the policy chooses from, and a person who drives by a horizon."""
        return self.config.policy.horizons_s

    @cached_property
    def sampler(self) -> TaskSampler:
        """Of the tasks, in which the nearest social vehicle waits for a person."""
        scenario, setting = self.config.scenario, self.config.play.setting
        assign = self.game.cast.assign
        families = {setting: scenario.families[setting]}
        return TaskSampler(scenario, families, torch.Generator(), lambda task: seat_person(assign(task)))

    def task(self, seed: int) -> Task:
        """The task of a seed."""
        self.sampler.generator.manual_seed(seed)
        return self.sampler.draw(1)

    def ego(self, task: Task) -> tuple[Driver, "Chooser | None"]:
        """The opponent at the wheel, who is no person, and its policy where it has one."""
        if self.baseline is not None:
            return self.config.evaluation.baselines[self.baseline].driver(self.game, task.noise_seed), None
        assert self.policy is not None
        key = task.noise_seed if self.config.evaluation.action == "sample" else None
        chooser = Chooser(self.policy, self.game, self.horizons_s, key)
        return HorizonDriver(chooser, self.game.plan), chooser


class Chooser:
    """The policy's choice in one world, which remembers the probabilities of its last one [A].

    key: [1] int64, from which horizons are drawn by their probabilities; None = the most probable one
    """

    def __init__(self, policy: Policy, game: Game, horizons_s: tuple[float, ...], key: Tensor | None) -> None:
        self._policy, self._game, self._horizons, self._key = policy, game, torch.tensor(horizons_s), key
        self._decisions = count()
        self.probability: list[float] = []

    def __call__(self, perception: Perception) -> Tensor:
        logits = self._policy(self._game.draw(perception))[0]
        self.probability = logits[0].float().softmax(-1).tolist()
        action = greedy_action(logits) if self._key is None else drawn_action(logits, self._key, next(self._decisions))
        return self._horizons[action][:, None]


@one_thread()
def open_arena(base: "RunConfig", overrides: Sequence[str], opponent: str, street: str) -> Arena:
    """The arena of two names; UserError where there is no such one, or where its config is not valid.

    base: config of the command line; overrides: those of the command line, which come after the opponent's and the
    street's
    """
    for key, name, known in (("opponent", opponent, base.play.opponents), ("street", street, base.play.streets)):
        if name not in known:
            raise UserError(f"{key} must be one of {', '.join(known)}, got {abbreviate(name)}")
    chosen = (*base.play.opponents[opponent].overrides, *base.play.streets[street].overrides)
    config = compose_config([*chosen, *overrides, *COMPUTED])
    for problem in config.play.check(config.scenario, config.planner.limits):
        raise UserError(f"{problem.key} must {problem.rule}, got {abbreviate(problem.value)}")
    baseline = base.play.opponents[opponent].baseline
    if baseline is None and config.checkpoint is None:
        raise UserError(f"play.opponents.{opponent}.overrides must name a checkpoint where baseline is null, got none")
    if baseline not in (None, *config.evaluation.baselines, PERSON):
        known_ones = ", ".join((*config.evaluation.baselines, PERSON))
        raise UserError(f"play.opponents.{opponent}.baseline must be one of {known_ones}, got {baseline}")
    policy = load_policy(config.checkpoint, config) if baseline is None and config.checkpoint is not None else None
    return Arena(opponent, street, config, with_learned(build_game(config), config, policy), policy)
