"""Drivers: functions from the perception of a vehicle to its motion in the next step.

Most drivers choose a prediction horizon and leave the rest to the planner (`HorizonDriver`). Others choose the motion
themselves, which needs no change in the simulator.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from negopipe.simulation.perception import Perception
from negopipe.simulation.state import Motion
from negopipe.tensors.tree import map_tensors

ChooseHorizon = Callable[[Perception], Tensor]
"""Perception of S agents -> prediction horizons [E, S] float32, s."""

Plan = Callable[[Perception, Tensor], Motion]
"""Perception of S agents, prediction horizons [E, S] (s) -> Motion [E, S]: `FrenetPlanner.plan`."""


class Driver(Protocol):
    """Driver of one agent in every world."""

    def drive(self, perception: Perception) -> Motion:
        """Motion of the agent (S = 1) in the next control step, from the perception of its vehicle."""
        ...


MakeDriver = Callable[[Tensor], Driver]
"""Keys of the random draws in E episodes that start together [E] int64 -> driver of one agent in them."""


class HorizonDriver:
    """Driver that chooses a prediction horizon and follows the planner."""

    def __init__(self, choose_horizon: ChooseHorizon, plan: Plan) -> None:
        self.choose_horizon = choose_horizon
        self.plan = plan

    def drive(self, perception: Perception) -> Motion:
        return self.plan(perception, self.choose_horizon(perception))


def given_horizon(horizon: Tensor) -> ChooseHorizon:
    """The horizons [E, S] (s) of one decision."""
    return lambda perception: horizon


def fixed_horizon(horizon_s: float) -> ChooseHorizon:
    """The same horizon at every decision."""

    def choose(perception: Perception) -> Tensor:
        return torch.full_like(perception.desired_speed, horizon_s)

    return choose


def drive_together(drivers: Sequence[Driver], perception: Perception) -> Motion:
    """Motion of all agents, one driver per agent; agents that share a planner are planned in one batched call.

    The result is the same as that of separate calls.
    """
    motions: dict[int, Motion] = {}
    by_plan: dict[Plan, dict[int, HorizonDriver]] = {}
    for agent, driver in enumerate(drivers):
        if isinstance(driver, HorizonDriver):
            by_plan.setdefault(driver.plan, {})[agent] = driver
        else:
            motions[agent] = driver.drive(perception.of(agent))
    for plan, agents in by_plan.items():
        horizon = torch.cat([driver.choose_horizon(perception.of(agent)) for agent, driver in agents.items()], 1)
        together = plan(perception.of_agents(list(agents)), horizon)
        motions |= {agent: _column(together, i) for i, agent in enumerate(agents)}
    return map_tensors(lambda *columns: torch.cat(columns, dim=1), *(motions[i] for i in range(len(drivers))))


def _column(motion: Motion, agent: int) -> Motion:
    return map_tensors(lambda field: field[:, agent : agent + 1], motion)
