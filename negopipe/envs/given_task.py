"""A task that the user of an environment gives: `reset(options={"task": {"street": 3, "style_horizon_s": 2.0}})`.

What is not given is drawn. A value holds for all vehicles that it names; `social_...` and `style_horizon_s` may also be
a list with a value for each social vehicle.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from negopipe.checks import Foresight, check_horizons
from negopipe.config.root import RunConfig
from negopipe.envs.overrides import in_one_line
from negopipe.errors import UserError
from negopipe.game.game import Game
from negopipe.simulation.state import EGO, Task

TASK = "task"
"""Name of the option of `reset`."""

NUMBERS = {
    "ego_start_distance_m": "start_distance",
    "ego_start_speed_mps": "start_speed",
    "ego_desired_speed_mps": "desired_speed",
    "social_start_distance_m": "start_distance",
    "social_start_speed_mps": "start_speed",
    "social_desired_speed_mps": "desired_speed",
    "style_horizon_s": "style_horizon",
}
"""Names of numbers, those of episodes.csv where it has them -> fields of `Task`."""

NAMES = ("street", "noise_seed", "social_driver", *NUMBERS)
"""All names, in the order in which they are set.

street: number of the street
noise_seed: of the perception's errors and the drivers' draws, from 0 to 2^24 - 1
social_driver: name in `population.drivers`, of all social vehicles
style_horizon_s: prediction horizon of the social vehicles at the start
"""


def given_task(drawn: Task, values: Any, game: Game, config: RunConfig) -> Task:
    """The drawn tasks [n] with the values that are given; UserError for a wrong name or value."""
    if not isinstance(values, Mapping):
        raise UserError(f"options.task must be a mapping of names to values, got {in_one_line(values)}")
    for name in values:
        if name not in NAMES:
            raise UserError(f"options.task must have names among {', '.join(NAMES)}, got {in_one_line(name)}")
    task = drawn
    if "street" in values:
        last = config.scenario.held_out_streets[-1]
        number = _integer("street", values["street"], 1, last)
        task = replace(task, direction=torch.sign(task.direction) * number)
    if "noise_seed" in values:
        number = _integer("noise_seed", values["noise_seed"], 0, 2**24 - 1)
        task = game.cast.assign(replace(task, noise_seed=torch.full_like(task.noise_seed, number)))
    if "social_driver" in values:
        task = game.cast.only(_driver(values["social_driver"], game)).assign(task)
    for name in (name for name in NUMBERS if name in values):
        task = _with_number(task, name, values[name], config)
    return task


def _integer(name: str, value: Any, first: int, last: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not first <= value <= last:
        raise UserError(f"options.task.{name} must be an integer from {first} to {last}, got {in_one_line(value)}")
    return value


def _driver(value: Any, game: Game) -> int:
    if value not in game.cast.names:
        raise UserError(
            f"options.task.social_driver must be one of {', '.join(game.cast.names)}, got {in_one_line(value)}"
        )
    return game.cast.names.index(value)


def _with_number(task: Task, name: str, value: Any, config: RunConfig) -> Task:
    field, n_others = NUMBERS[name], task.direction.shape[1] - 1
    is_ego = name.startswith("ego_")
    numbers = _numbers(name, value, 1 if is_ego else n_others, config)
    columns = slice(EGO, EGO + 1) if is_ego else slice(EGO + 1, None)
    changed: Tensor = getattr(task, field).clone()
    if name == "style_horizon_s" and bool(changed[:, columns].isnan().any()):
        raise UserError(
            f"options.task.{name} must be left out where social_driver chooses its horizons, got {in_one_line(value)}"
        )
    changed[:, columns] = torch.tensor(numbers)
    fields: dict[str, Any] = {field: changed}
    return replace(task, **fields)


def _numbers(name: str, value: Any, n: int, config: RunConfig) -> list[float]:
    """The value of each of `n` vehicles."""
    values = list(value) if isinstance(value, list | tuple) else [value] * n
    is_number = all(isinstance(each, int | float) and not isinstance(each, bool) for each in values)
    if len(values) != n or not is_number or not all(each >= 0 for each in values):
        many = f" or a list of {n} of them" if n > 1 else ""
        raise UserError(f"options.task.{name} must be a number from 0{many}, got {in_one_line(value)}")
    if name != "style_horizon_s" and not all(math.isfinite(each) for each in values):
        raise UserError(f"options.task.{name} must be finite, got {in_one_line(value)}")
    if name == "style_horizon_s":
        foresight = Foresight(config.planner.horizon_s, config.planner.give_way is not None)
        for problem in check_horizons({f"options.task.{name}": values}, config.scenario.dt_s, foresight):
            raise UserError(f"{problem.key} must {problem.rule}, got {problem.value}")
    return [float(each) for each in values]
