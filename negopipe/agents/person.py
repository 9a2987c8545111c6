"""A person at the wheel: a vehicle on its route whose speed follows pedals, or a planner with the person's horizon.

The commands come from outside, decision by decision: live from a page, or from the record of an encounter.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from negopipe.agents.driver import Driver, HorizonDriver, Plan
from negopipe.agents.driver_config import MotionDriver
from negopipe.agents.route_following import along_route
from negopipe.checks import Problem
from negopipe.planner.config import LimitConfig
from negopipe.schema import PositiveFloat, schema
from negopipe.simulation.perception import Perception
from negopipe.simulation.simulator import Simulator
from negopipe.simulation.state import NEAREST, NOBODY, Motion, Task

PERSON = "person"
"""Name of the driver in records."""

PEDALS = ("go", "ease", "brake")
"""Commands of a person with pedals, in the order of their numbers."""


@schema
class PedalsConfig:
    """Accelerations by command; `conf/play/local.yaml` says what each value means."""

    go_mps2: PositiveFloat
    ease_mps2: PositiveFloat
    brake_mps2: PositiveFloat

    def check(self, key: str, limits: LimitConfig) -> Iterator[Problem]:
        """A person's car can do what the planner's vehicles can."""
        most = {"go_mps2": "accel_max_mps2", "ease_mps2": "full_braking_mps2", "brake_mps2": "full_braking_mps2"}
        for name, limit in most.items():
            allowed, value = getattr(limits, limit), getattr(self, name)
            if value > allowed:
                yield Problem(f"{key}.{name}", f"be at most planner.limits.{limit} = {allowed:g}", value)


def seat_person(task: Task) -> Task:
    """The tasks [E] with nobody of the population, and no style, for the vehicle that a person drives: the nearest."""
    casting = task.casting
    nothing = {
        "style_horizon": torch.nan, "next_style_horizon": torch.nan, "switch_time": torch.inf, "patience": torch.inf,
    }  # fmt: skip
    of_nobody = {"driver": NOBODY, "redraw_steps": 0, "reaction_steps": 0, "lapse_share": 0.0}
    emptied = {name: _with_column(getattr(casting, name), value) for name, value in of_nobody.items()}
    fields = {name: _with_column(getattr(task, name), value) for name, value in nothing.items()}
    return replace(task, casting=replace(casting, **emptied), **fields)


def _with_column(values: Tensor, value: float) -> Tensor:
    changed = values.clone()
    changed[:, NEAREST] = value
    return changed


def pedal_driver(pedals: PedalsConfig, simulator: Simulator, next_pedal: Callable[[], Tensor]) -> Driver:
    """Driver on its route. `go` accelerates up to the desired speed, `ease` rolls out, `brake` stops; none reverses.

    next_pedal: source of the pedals [E, S] int64 of the next decision, indices into `PEDALS`
    """
    dt_s, road = simulator.scenario.dt_s, simulator.road
    accel_of = torch.tensor([pedals.go_mps2, -pedals.ease_mps2, -pedals.brake_mps2], device=road.device)

    def drive(perception: Perception) -> Motion:
        now = road.to_route(perception.own, perception.direction)
        up_to_desired = ((perception.desired_speed - now.s_dot) / dt_s).clamp(min=-pedals.ease_mps2)
        accel = torch.minimum(accel_of[next_pedal()], up_to_desired)
        return along_route(simulator, perception, now, accel)

    return MotionDriver(drive)


def horizon_driver(plan: Plan, next_horizon: Callable[[], Tensor]) -> Driver:
    """Driver by the planner; next_horizon: source of the person's prediction horizons [E, S] (s)."""
    return HorizonDriver(lambda perception: next_horizon(), plan)
