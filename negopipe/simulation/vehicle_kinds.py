"""Kinds of social vehicles: their sizes and speeds, drawn for every vehicle of a task."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from negopipe.schema import FileName, PositiveFloat, SizeRange, SpeedRange, schema
from negopipe.simulation.state import EGO, Task
from negopipe.tensors.stateless_rng import mix, uniform

KINDS = 0x5123
"""Offset of the key from which kinds, sizes and speeds are drawn, apart from the other draws of an episode."""
KIND, LENGTH, WIDTH, SPEED = 0, 1, 2, 3
"""Channels of that key."""


@schema
class VehicleKindConfig:
    """A kind of vehicle; each of its numbers may also be the interval that it is drawn from.

    weight: share of the social vehicles, relative to the other kinds
    length_m, width_m: footprint
    desired_speed_mps: null = as `scenario.desired_speed_mps`. A vehicle with a speed of its own starts no faster
    """

    weight: PositiveFloat
    length_m: SizeRange
    width_m: SizeRange
    desired_speed_mps: SpeedRange | None


VehicleKinds = dict[FileName, VehicleKindConfig]
"""Kinds by name; none: every vehicle is like the ego."""


def draw_kinds(kinds: Mapping[str, VehicleKindConfig], task: Task) -> Task:
    """The tasks with a kind drawn for every social vehicle; the ego stays as it is.

    All draws are functions of the tasks' noise seeds, so kinds change nothing else of a task.
    """
    if not kinds:
        return task
    device, configs = task.direction.device, list(kinds.values())
    vehicle = torch.arange(task.direction.shape[1], device=device)
    key = mix(mix(mix(task.noise_seed)[:, None] + vehicle) + KINDS)
    weights = torch.tensor([kind.weight for kind in configs], dtype=torch.float64, device=device)
    until = (weights.cumsum(0) / weights.sum()).float()
    kind = torch.searchsorted(until, uniform(key, KIND), right=True).clamp(max=len(configs) - 1)
    length, width, speed = (
        _between(torch.tensor([bounds(value) for value in values], device=device)[kind], uniform(key, channel))
        for channel, values in (
            (LENGTH, [each.length_m for each in configs]),
            (WIDTH, [each.width_m for each in configs]),
            (SPEED, [torch.nan if each.desired_speed_mps is None else each.desired_speed_mps for each in configs]),
        )
    )
    is_social, has_speed = vehicle != EGO, (vehicle != EGO) & ~speed.isnan()
    return replace(
        task,
        length=torch.where(is_social, length, task.length),
        width=torch.where(is_social, width, task.width),
        desired_speed=torch.where(has_speed, speed, task.desired_speed),
        start_speed=torch.where(has_speed, task.start_speed.minimum(speed), task.start_speed),
    )


def bounds(value: float | tuple[float, float]) -> tuple[float, float]:
    """Lowest and highest value of a number or an interval."""
    return value if isinstance(value, tuple) else (value, value)


def _between(intervals: Tensor, share: Tensor) -> Tensor:
    """[...] float32 from intervals [..., 2]; an end is met exactly where both ends are the same."""
    low, high = intervals.unbind(-1)
    return low + (high - low) * share
