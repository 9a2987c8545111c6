"""Who drives a vehicle: what the vehicle perceives goes in, its motion for the next step comes out.

Everything that drives stands behind `Driver`. Most drivers choose a prediction horizon and leave the rest to the
planner (`HorizonDriver`); others may move their vehicle as they like without a change in the simulator.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from negopipe.simulation.perception import Perception
from negopipe.simulation.state import Motion, map_tensors

ChooseHorizon = Callable[[Perception], Tensor]
"""Perception of one seat (S = 1) -> prediction horizon [E, 1] float32, s."""

Plan = Callable[[Perception, Tensor], Motion]
"""Perception of S seats, prediction horizons [E, S] (s) -> Motion [E, S]: `FrenetPlanner.plan`."""


class Driver(Protocol):
    """Drives one seat in every world."""

    def drive(self, perception: Perception) -> Motion:
        """Motion of the seat (S = 1) for the next control step, from what its vehicle perceives."""
        ...


MakeDriver = Callable[[Tensor], Driver]
"""Numbers of E episodes [E] int64, from which what is random may be drawn -> the driver of one seat in them. They start
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
    """One driver per seat. Seats that share a planner are planned in one batched call.

    The result is the same as letting each driver drive alone; batching only saves time.
    """
    motions: dict[int, Motion] = {}
    by_plan: dict[Plan, dict[int, HorizonDriver]] = {}
    for seat, driver in enumerate(drivers):
        if isinstance(driver, HorizonDriver):
            by_plan.setdefault(driver.plan, {})[seat] = driver
        else:
            motions[seat] = driver.drive(perception.of(seat))
    for plan, seats in by_plan.items():
        horizon = torch.cat([driver.choose_horizon(perception.of(seat)) for seat, driver in seats.items()], 1)
        together = plan(perception.of_seats(list(seats)), horizon)
        motions |= {seat: _column(together, i) for i, seat in enumerate(seats)}
    return map_tensors(lambda *columns: torch.cat(columns, dim=1), *(motions[i] for i in range(len(drivers))))


def _column(motion: Motion, seat: int) -> Motion:
    return map_tensors(lambda field: field[:, seat : seat + 1], motion)
