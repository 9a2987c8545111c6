"""Who drives a vehicle: what the vehicle perceives goes in, its motion for the next step comes out.

Everything that drives stands behind `Driver`. Most drivers choose a prediction horizon and leave the rest to the
planner (`HorizonDriver`); others may move their vehicle as they like without a change in the simulator.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from negopipe.simulation.perception import Perception
from negopipe.simulation.state import Motion
from negopipe.tensors.tree import map_tensors

ChooseHorizon = Callable[[Perception], Tensor]
"""Perception of one agent (S = 1) -> prediction horizon [E, 1] float32, s."""

Plan = Callable[[Perception, Tensor], Motion]
"""Perception of S agents, prediction horizons [E, S] (s) -> Motion [E, S]: `FrenetPlanner.plan`."""


class Driver(Protocol):
    """Drives one agent in every world."""

    def drive(self, perception: Perception) -> Motion:
        """Motion of the agent (S = 1) for the next control step, from what its vehicle perceives."""
        ...


MakeDriver = Callable[[Tensor], Driver]
"""Keys of E episodes [E] int64, from which what is random may be drawn -> the driver of one agent in them. They start
together."""


class HorizonDriver:
    """Chooses a prediction horizon and lets the planner drive."""

    def __init__(self, choose_horizon: ChooseHorizon, plan: Plan) -> None:
        self.choose_horizon = choose_horizon
        self.plan = plan

    def drive(self, perception: Perception) -> Motion:
        return self.plan(perception, self.choose_horizon(perception))


def own_style(perception: Perception) -> Tensor:
    """The horizon of a social vehicle: its driving style."""
    return perception.style_horizon


def fixed_horizon(horizon_s: float) -> ChooseHorizon:
    """The same horizon at every decision."""

    def choose(perception: Perception) -> Tensor:
        return torch.full_like(perception.style_horizon, horizon_s)

    return choose


def drive_together(drivers: Sequence[Driver], perception: Perception) -> Motion:
    """One driver per agent. Agents that share a planner are planned in one batched call.

    The result is the same as letting each driver drive alone; batching only saves time.
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
