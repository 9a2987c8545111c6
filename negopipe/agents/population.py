"""The population: the drivers of the social vehicles and their shares.

`Cast` draws a driver for every social vehicle of a task, and drives all of them in one batched call, whatever the
mixture in the batch.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from math import ceil
from typing import Annotated, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from negopipe.agents.driver import Plan
from negopipe.agents.driver_config import HorizonRule, MotionRule
from negopipe.agents.drivers import RuleConfig
from negopipe.checks import WHOLE, Foresight, Problem, check_horizons, check_times
from negopipe.schema import FileName, Fraction, Interval, NonNegativeFloat, PathText, PositiveFloat, PositiveInt, schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.scenario import Styles
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import EGO, NOBODY, Casting, Motion, Task
from negopipe.tensors.stateless_rng import mix, uniform
from negopipe.tensors.tree import tree_where

CAST = 0xCA57
"""Offset of the key from which drivers and what they are like are drawn, apart from the other draws of an episode."""
DRIVER, REACTION, HORIZON = 0, 1, 2
"""Channels of that key; the horizons drawn later follow the first one."""


@schema
class PlannerStyle:
    """The planner with a prediction horizon of its own; both null = the style and the style switch of the family.

    horizons_s: s, each equally likely
    interval_s: uniform interval of the horizon, s
    redraw_s: time after which the horizon is drawn anew, again and again, s; null = it is kept
    reaction_s: interval of the time by which it goes by what it saw before, drawn in whole control steps, s
    lapse_share: share of the seconds in which it sees nobody
    """

    kind: Literal["planner"]
    horizons_s: Styles | None
    interval_s: Interval | None
    redraw_s: PositiveFloat | None
    reaction_s: Interval
    lapse_share: Fraction

    @model_validator(mode="after")
    def _draws_from_one(self) -> "PlannerStyle":
        if self.horizons_s is not None and self.interval_s is not None:
            raise ValueError("must have horizons_s or interval_s, both are given")
        if self.redraw_s is not None and not self.is_own:
            raise ValueError("must have horizons_s or interval_s where redraw_s is given, both are null")
        return self

    @property
    def is_own(self) -> bool:
        """Whether the horizon is the driver's own and not the family's."""
        return self.horizons_s is not None or self.interval_s is not None

    def check(self, key: str, dt_s: float, foresight: Foresight) -> Iterator[Problem]:
        """foresight: of the planner."""
        yield from check_horizons({f"{key}.horizons_s": self.horizons_s or ()}, dt_s, foresight)
        yield from check_horizons({f"{key}.interval_s": self.interval_s or ()}, dt_s, foresight)
        redraw_s = () if self.redraw_s is None else (self.redraw_s,)
        yield from check_times({f"{key}.redraw_s": redraw_s, f"{key}.reaction_s": self.reaction_s}, dt_s)

    def draw(self, share: Tensor) -> Tensor:
        """Horizons [...] (s) from uniform numbers [...] in (0, 1)."""
        if self.interval_s is not None:
            low, high = self.interval_s
            return low + (high - low) * share
        values = torch.tensor(self.horizons_s, device=share.device)
        return values[(share * len(values)).long().clamp(max=len(values) - 1)]


@schema
class PolicyDriver:
    """A trained policy on the other side.

    checkpoint: as the run's `checkpoint`; its network and its observation must be those of the config
    action: greedy = the most probable horizon; sample = drawn by the probabilities
    """

    kind: Literal["policy"]
    checkpoint: PathText
    action: Literal["greedy", "sample"]

    def check(self, key: str, dt_s: float, foresight: Foresight) -> Iterator[Problem]:
        yield from ()


@schema
class SelfDriver:
    """The policy that is being trained or evaluated, on the other side; action: as for `PolicyDriver`.

    A policy that is being trained learns from the actions that it draws here as well: self-play.
    """

    kind: Literal["self"]
    action: Literal["greedy", "sample"]

    def check(self, key: str, dt_s: float, foresight: Foresight) -> Iterator[Problem]:
        yield from ()


@schema
class LeagueDriver:
    """Earlier states of the policy that is being trained, with drawn actions; in an evaluation, the policy itself.

    n_members: states that are kept at a time; each is a driver of its own, `<name>_1` and so on
    every_iterations: iterations of the training after which the policy as it is takes the place of the oldest one
    draw: uniform = all members alike; hardest = in proportion to the share of lost episodes with each
    """

    kind: Literal["league"]
    n_members: PositiveInt
    every_iterations: PositiveInt
    draw: Literal["uniform", "hardest"]
    action: ClassVar[str] = "sample"

    def check(self, key: str, dt_s: float, foresight: Foresight) -> Iterator[Problem]:
        yield from ()


@schema
class SocialDriverConfig:
    """A driver of the population.

    weight: share of the social vehicles that it drives, relative to the other drivers
    """

    weight: NonNegativeFloat
    driver: Annotated[PlannerStyle | PolicyDriver | SelfDriver | LeagueDriver | RuleConfig, Field(discriminator="kind")]


@schema
class PopulationConfig:
    """The drivers of the social vehicles by name; `conf/population/styles.yaml` says more."""

    drivers: Annotated[dict[FileName, SocialDriverConfig], Field(min_length=1)]

    @model_validator(mode="after")
    def _has_weight(self) -> "PopulationConfig":
        if sum(each.weight for each in self.drivers.values()) <= 0:
            weights = ", ".join(f"{name} {each.weight:g}" for name, each in self.drivers.items())
            raise ValueError(f"drivers must have a weight above 0 in all, got {weights}")
        return self

    @property
    def planners(self) -> dict[str, PlannerStyle]:
        """The drivers that follow a planner with a style, by name."""
        return {name: d.driver for name, d in self.drivers.items() if isinstance(d.driver, PlannerStyle)}

    @property
    def is_attentive(self) -> bool:
        """Whether no driver reacts late or lapses."""
        return not any(planner.reaction_s[1] > 0 or planner.lapse_share > 0 for planner in self.planners.values())

    @property
    def has_learners(self) -> bool:
        """Whether there is a driver from whose actions the policy learns."""
        return any(is_learner(each.driver) for each in self.drivers.values())

    def check(self, dt_s: float, foresight: Foresight, remembered_s: float) -> Iterator[Problem]:
        """foresight: of the planner; remembered_s: age of the oldest state of another that a driver knows."""
        for name, planner in self.planners.items():
            if planner.reaction_s[1] > remembered_s + WHOLE:
                rule = f"be at most {remembered_s:g} s, as far as a vehicle remembers by observation.n_frames"
                yield Problem(f"population.drivers.{name}.driver.reaction_s", rule, planner.reaction_s[1])
        for name, each in self.drivers.items():
            yield from each.driver.check(f"population.drivers.{name}.driver", dt_s, foresight)

    def check_self(self, place: str) -> Iterator[Problem]:
        """A `place` where no policy is trained or evaluated, so that none can drive as itself."""
        for name, each in self.drivers.items():
            if isinstance(each.driver, SelfDriver | LeagueDriver):
                rule = f"name a checkpoint (kind: policy) in {place}, where no policy is at hand"
                yield Problem(f"population.drivers.{name}.driver.kind", rule, each.driver.kind)


def is_learner(driver: object) -> bool:
    """Whether the actions of a driver are drawn by the policy that is being trained, which then learns from them."""
    return isinstance(driver, SelfDriver) and driver.action == "sample"


def is_plain(driver: object) -> bool:
    """Whether a driver is the attentive planner in the styles of the families."""
    return isinstance(driver, PlannerStyle) and not (driver.is_own or driver.reaction_s[1] or driver.lapse_share)


def _entries(population: PopulationConfig) -> Iterator[tuple[str, float, object]]:
    """Name, weight and driver of everybody; the members of a league share its weight."""
    for name, each in population.drivers.items():
        if isinstance(each.driver, LeagueDriver):
            n = each.driver.n_members
            yield from ((f"{name}_{i + 1}", each.weight / n, each.driver) for i in range(n))
        else:
            yield name, each.weight, each.driver


class Cast:
    """The population at work in worlds of one scenario.

    names: of the drivers; a task holds their indices
    weights: [K] float64, of the drivers
    learned: drivers that a policy drives, by index
    learners: of these, by index, those whose drawn actions are decisions of the policy that is being trained
    """

    def __init__(self, population: PopulationConfig, simulator: Simulator) -> None:
        self.names, weights, drivers = zip(*_entries(population), strict=True)
        self.weights = torch.tensor(weights, dtype=torch.float64, device=simulator.road.device)
        self.learned = {i: d for i, d in enumerate(drivers) if isinstance(d, PolicyDriver | SelfDriver | LeagueDriver)}
        self.learners = tuple(index for index, driver in enumerate(drivers) if is_learner(driver))
        self._planners = {i: d for i, d in enumerate(drivers) if isinstance(d, PlannerStyle)}
        self._horizon_rules = {i: d.choose(simulator) for i, d in enumerate(drivers) if isinstance(d, HorizonRule)}
        self._motion_rules = {i: d.rule(simulator) for i, d in enumerate(drivers) if isinstance(d, MotionRule)}
        self._dt_s, n_steps = simulator.scenario.dt_s, simulator.scenario.episode_steps
        self._redraw_steps = {i: round((d.redraw_s or 0) / self._dt_s) for i, d in self._planners.items()}
        self._n_redrawn = max((ceil(n_steps / n) for n in self._redraw_steps.values() if n), default=0)

    def weighted(self, weights: Tensor) -> "Cast":
        """The same cast with other weights [K] of its drivers."""
        cast = copy(self)
        cast.weights = weights
        return cast

    def only(self, index: int) -> "Cast":
        """The same cast with one driver for all social vehicles."""
        return self.weighted(torch.arange(len(self.names)).to(self.weights.device) == index)

    def assign(self, task: Task, ego: int = NOBODY) -> Task:
        """The tasks with a driver for every social vehicle, and with the horizons that these bring along.

        All draws are functions of the tasks' noise seeds, so a population changes nothing else of a task.
        ego: driver of the ego, by index; NOBODY = the ego is driven by whoever drives the episodes
        """
        vehicle = torch.arange(task.direction.shape[1], device=task.direction.device)
        key = mix(mix(mix(task.noise_seed)[:, None] + vehicle) + CAST)
        until = (self.weights.cumsum(0) / self.weights.sum()).float()
        driver = torch.searchsorted(until, uniform(key, DRIVER), right=True).clamp(max=len(until) - 1)
        driver[:, EGO] = ego
        style, has_own = task.style_horizon, torch.zeros_like(driver, dtype=torch.bool)
        for index in range(len(self.names)):
            is_its, planner = driver == index, self._planners.get(index)
            if planner is None or planner.is_own:
                drawn = style.new_full((), torch.nan) if planner is None else planner.draw(uniform(key, HORIZON))
                style, has_own = torch.where(is_its, drawn, style), has_own | is_its
        return replace(
            task,
            casting=self._casting(driver, key),
            style_horizon=style,
            next_style_horizon=torch.where(has_own, torch.nan, task.next_style_horizon),
            switch_time=torch.where(has_own, torch.inf, task.switch_time),
            patience=torch.where(has_own, torch.inf, task.patience),
        )

    def _casting(self, driver: Tensor, key: Tensor) -> Casting:
        """What the drivers [E, V] are like, drawn with the keys [E, V]."""
        redraw_steps, reaction_steps = torch.zeros_like(driver), torch.zeros_like(driver)
        lapse_share = torch.zeros_like(driver, dtype=torch.float32)
        redrawn = lapse_share.new_full((*driver.shape, self._n_redrawn), torch.nan)
        for index, planner in self._planners.items():
            is_its = driver == index
            late = self._reaction_steps(planner, uniform(key, REACTION))
            reaction_steps = torch.where(is_its, late, reaction_steps)
            lapse_share = torch.where(is_its, planner.lapse_share, lapse_share)
            if n_kept := self._redraw_steps[index]:
                redraw_steps = torch.where(is_its, n_kept, redraw_steps)
                drawn = torch.stack([planner.draw(uniform(key, HORIZON + i)) for i in range(self._n_redrawn)], -1)
                redrawn = torch.where(is_its[..., None], drawn, redrawn)
        return Casting(driver, redraw_steps, redrawn, reaction_steps, lapse_share)

    def _reaction_steps(self, planner: PlannerStyle, share: Tensor) -> Tensor:
        """Whole control steps [...], each between the bounds equally likely, from uniform numbers [...]."""
        first, last = (round(bound / self._dt_s) for bound in planner.reaction_s)
        return (first + ((last - first + 1) * share).long()).clamp(max=last)

    def named(self, driver: Tensor) -> np.ndarray:
        """Names [E, V] of the drivers [E, V]; empty where a vehicle has none."""
        return np.array(["", *self.names])[driver.cpu().numpy() - NOBODY]

    def drive(self, perception: Perception, horizon: Tensor, plan: Plan) -> Motion:
        """Motion of S agents [E, S] by the rules of their drivers, else by the planner.

        horizon: [E, S] s, of those who follow the planner and do not choose by a rule
        """
        for index, choose in self._horizon_rules.items():
            horizon = torch.where(perception.driver == index, choose(perception), horizon)
        motion = plan(perception, horizon)
        for index, rule in self._motion_rules.items():
            motion = tree_where(perception.driver == index, rule(perception), motion)
        return motion
