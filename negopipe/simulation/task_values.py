"""Values of tasks, computed from uniform random numbers between 0 and 1, the shares."""

import torch
from torch import Tensor

from negopipe.simulation.state import ABSENT_M
from negopipe.simulation.vehicle_kinds import bounds
from negopipe.tensors.stateless_rng import mix, uniform

QUEUE = 0x9E0E
"""Offset of the key from which the spacing of queues is drawn, apart from the other draws of an episode."""

ABSENT_APART_M = 50.0
"""Distance between absent vehicles, m."""

ABSENCE = 0xAB5E
"""Offset of the key from which the absence of queues is drawn, apart from the other draws of an episode."""


def one_of(values: Tensor, n_values: Tensor, family: Tensor, share: Tensor) -> Tensor:
    """[n, V] float32: one of the values of the family for each vehicle."""
    last = (n_values - 1)[family, None]
    index = (share * n_values[family, None]).long().minimum(last)
    return values[family].gather(1, index)


def queue(spacing_m: float | tuple[float, float], noise_seed: Tensor, n: int, channel: int) -> Tensor:
    """[E, n] m: distances of a queue's vehicles behind the first, functions of the tasks' noise seeds."""
    vehicle = torch.arange(n, device=noise_seed.device)
    low, high = bounds(spacing_m)
    if low == high:
        return (vehicle * low).expand(len(noise_seed), -1)
    spacing = between((low, high), uniform(mix(mix(noise_seed)[:, None] + vehicle) + QUEUE, channel))
    return (spacing * (vehicle > 0)).cumsum(1)


def without_absent(distance: Tensor, noise_seed: Tensor, share: float, n_social: int, n_followers: int) -> Tensor:
    """Start distances [E, V] (m) in which the vehicles of absent queues stand far behind their targets.

    A queue is what follows the first oncoming vehicle, or the ego. It is absent in the share of the tasks.
    """
    if share == 0:
        return distance
    queue_of = (
        [-1, -1] + [0] * (n_social - 1) + [1] * n_followers
    )  # the ego and the first oncoming one are always there
    number = torch.tensor(queue_of, device=distance.device)
    key = mix(noise_seed) + ABSENCE
    is_absent = torch.stack([uniform(key, queue) for queue in range(2)], -1) < share
    is_absent = is_absent[:, number.clamp(min=0)] & (number >= 0)
    apart = torch.arange(len(queue_of), device=distance.device) * ABSENT_APART_M
    return torch.where(is_absent, -ABSENT_M - apart, distance)


def between(interval: tuple[float, float], share: Tensor) -> Tensor:
    """Values of one interval for all rows, with the shape of `share`."""
    low, high = interval
    return low + (high - low) * share


def between_each(intervals: Tensor, share: Tensor) -> Tensor:
    """[n, V] float32 from the intervals [n, 2] of the rows; an interval at infinity gives infinity."""
    low, high = intervals[:, :1], intervals[:, 1:]
    return torch.where(low.isinf(), low, low + (high - low) * share)


def outside(gaps: Tensor, intervals: Tensor, share: Tensor) -> Tensor:
    """[n, V] float32 from the intervals [n, 2] of the rows without their gaps [n, G, 2].

    A place is drawn in an interval that is shorter by the gaps, and moved up by every gap that it reaches. The bounds
    correct float32 rounding into a gap or past the end of the interval.
    """
    low, high = intervals[:, :1], intervals[:, 1:]
    length = high - low - gaps.diff(dim=-1).nan_to_num(nan=0.0).sum(dim=1)  # NaN: inf - inf, of the padding
    distance = low + length * share
    for gap in gaps.unbind(dim=1):
        start, end = gap.split(1, dim=1)
        distance = torch.where(distance >= start, (distance + (end - start)).maximum(end), distance)
    return distance.clamp(low, high)


def with_ego(ego: float, social: Tensor) -> Tensor:
    """[n, 1 + S]: the value `ego` in the ego's column, then those of the social vehicles."""
    return torch.cat([social.new_full((len(social), 1), ego), social], dim=1)
