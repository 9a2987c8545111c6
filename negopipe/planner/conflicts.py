"""Conflicts of paths with predicted vehicles: which distances travelled are blocked at which time.

Every path is compared with every predicted footprint at a few places around it. The depth of overlap there bounds the
stretch of the path that is blocked, so a candidate is checked by comparing its distances travelled with the stretch.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.planner.config import PlannerConfig
from negopipe.planner.lateral import LateralCandidates
from negopipe.planner.prediction import PredictedPath
from negopipe.planner.situation import Situation
from negopipe.simulation.geometry import Boxes, overlap_depth
from negopipe.simulation.road import Road
from negopipe.simulation.sizes import Sizes
from negopipe.tensors.materialize import materialize


class Blocked(NamedTuple):
    """First and last blocked distance travelled, [L, O, T, N] m; first > last where nothing is in the way."""

    first: Tensor
    last: Tensor

    def holds_up(self, travelled: Tensor) -> Tensor:
        """[L, C, N] bool: a vehicle that has `travelled` [C, T, N] (m) is within the stretch at some time."""
        travelled = travelled[:, None]  # [C, O, T, N]
        within = torch.minimum(travelled - self.first[:, None], self.last[:, None] - travelled)  # [L, C, O, T, N]
        return within.amax((2, 3)) > 0

    @property
    def free_m(self) -> Tensor:
        """[N] m: distance to the first place that is ever blocked ahead, on the path on which it is the farthest."""
        return torch.where(self.last > 0, self.first, torch.inf).amin((1, 2)).amax(0)


class _Footprints(NamedTuple):
    """Predicted footprints with their clearances, in the viewer's route frame; fields [O, T, N], m and 1."""

    s: Tensor
    d: Tensor
    tan_heading: Tensor
    half_length: Tensor
    half_width: Tensor


class ConflictCheck:
    """Check of L paths against O predicted vehicles at T times; axes as in `frenet.py`.

    around: [K] m, places around a predicted vehicle, evenly spread over the distances at which two footprints with
        their clearances can touch at all
    """

    def __init__(
        self,
        config: PlannerConfig,
        road: Road,
        sizes: Sizes,
        lateral: LateralCandidates,
        device: torch.device | str,
    ) -> None:
        self.clearance, self.road, self.lateral = config.clearance, road, lateral
        reach = config.touching_m(sizes.largest)
        self.around = torch.linspace(-reach, reach, config.n_around(sizes.largest)).to(device)

    def depth(
        self, now: Situation, coefficients: tuple[Tensor, ...], predicted: PredictedPath
    ) -> tuple[Tensor, Tensor]:
        """Depth of overlap [L, K, O, T, N] (m) at the places around predicted vehicles, and the distances travelled
        [K, O, T, N] (m) to the places.
        """
        size, other = now.size, self._footprints(now, predicted)
        around = self.around[:, None, None, None]  # [K, O, T, N]
        at = other.s - now.route.s + around
        d, d_prime, _ = self.lateral.follow(coefficients, now.route.s, now.direction, at)
        u, v, tan_heading = self.road.in_tangent_frame(other.s, now.direction, around, d, d_prime)  # [L, K, O, T, N]
        cos, other_cos = torch.rsqrt(1 + tan_heading**2), torch.rsqrt(1 + other.tan_heading**2)
        own = Boxes(u, v, cos, tan_heading * cos, size.length / 2, size.width / 2)
        x, sin = torch.zeros_like(other.d), other.tan_heading * other_cos
        other_box = Boxes(x, other.d, other_cos, sin, other.half_length, other.half_width)
        return overlap_depth(own, other_box), at

    def _footprints(self, now: Situation, predicted: PredictedPath) -> "_Footprints":
        size, clearance = now.others.size_at_times, self.clearance
        half_length = size.length / 2 + clearance.ahead_m
        half_width = size.width / 2 + clearance.beside_m + clearance.beside_s * now.others.speed.abs()[:, None]
        fields = (*predicted, half_length, half_width)
        like = predicted.s
        stored = (each.expand_as(like) if isinstance(each, Tensor) else torch.full_like(like, each) for each in fields)
        return _Footprints(*materialize(*stored))  # the innermost loop reads them

    def blocked(self, depth: Tensor, at: Tensor, is_considered: Tensor) -> Blocked:
        """Stretch that is blocked by depths and distances of `depth`.

        The depth changes by about one metre per metre at most, so a path is free for x metres from a place with depth
        -x. The stretch begins and ends there.

        is_considered: [O, T, N] bool, the other is seen and the time lies within the prediction horizon
        """
        before, after = depth[:, :-1], depth[:, 1:]
        step = self.around[1] - self.around[0]
        entered = at[:-1] + torch.minimum((-before).clamp(min=0), step)
        left = at[1:] - torch.minimum((-after).clamp(min=0), step)
        first = torch.where(is_considered, torch.where(after > 0, entered, torch.inf), torch.inf).amin(1)
        last = torch.where(is_considered, torch.where(before > 0, left, -torch.inf), -torch.inf).amax(1)
        return Blocked(first, last)
