"""Conflicts of paths with predicted vehicles: which distances travelled are blocked at which time.

Every path is compared with every predicted footprint at a few places around it. The depth of overlap there bounds the
stretch of the path that is blocked, so a candidate is checked by comparing its distances travelled with the stretch.
"""

import math
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
from negopipe.tensors.sparse import SparseFunction


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


class ConflictCheck:
    """Check of L paths against O predicted vehicles at T times; axes as in `frenet.py`.

    Only what is predicted within the prediction horizon of a vehicle that is seen is checked.

    around: [K] m, places around a predicted vehicle, evenly spread over the distances at which two footprints with
        their clearances can touch at all
    slacks_m: depths of overlap that are let pass, each of which gives a stretch that is blocked
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
        self.slacks_m = (0.0, config.braking.slack_m) if config.braking.n_candidates else (0.0,)
        nothing = torch.tensor([math.inf, -math.inf], device=device)  # is blocked
        self._ends = SparseFunction(self._ends_of, nothing.repeat_interleave(len(self.slacks_m) * lateral.n_candidates))

    def blocked(
        self, now: Situation, coefficients: tuple[Tensor, ...], predicted: PredictedPath, is_considered: Tensor
    ) -> list[Blocked]:
        """What the predicted vehicles block, for each of the slacks.

        is_considered: [O, T, N] bool, the other is seen and the time lies within the prediction horizon
        """
        size = _like(now.route.s, *now.size)
        of_vehicles = torch.stack([now.route.s, now.direction, *size, *(c for each in coefficients for c in each)])
        of_pairs = torch.stack(self._footprints(now, predicted))
        first, last = self._ends(is_considered, of_vehicles, of_pairs).unflatten(0, (2, len(self.slacks_m), -1))
        return [Blocked(*each) for each in zip(first, last, strict=True)]

    def _footprints(self, now: Situation, predicted: PredictedPath) -> tuple[Tensor, ...]:
        """Predicted footprints with their clearances, in the viewer's route frame; fields [O, T, N].

        s, d (m), cosine and sine of the heading, half of the length and of the width (m)
        """
        size, clearance = now.others.size_at_times, self.clearance
        half_length = size.length / 2 + clearance.ahead_m
        half_width = size.width / 2 + clearance.beside_m + clearance.beside_s * now.others.speed.abs()[:, None]
        s, d, tan_heading = predicted
        cos = torch.rsqrt(1 + tan_heading**2)
        fields = (s, d, cos, tan_heading * cos, half_length, half_width)
        return materialize(*_like(s, *fields))  # the innermost loop reads them

    def _ends_of(self, of_vehicles: Tensor, of_pairs: Tensor) -> Tensor:
        """First and last blocked distance travelled (m) by slack and path, of vehicles [A, ...] and pairs [B, ...]."""
        route_s, direction, length, width = of_vehicles[:4]
        coefficients = of_vehicles[4:].unflatten(0, (-1, self.lateral.n_candidates)).unbind(0)
        s, d, cos, sin, half_length, half_width = of_pairs
        around = self.around.reshape(-1, *[1] * s.dim())  # [K, ...]
        at = s - route_s + around
        own_d, d_prime, _ = self.lateral.follow(coefficients, route_s, direction, at)
        u, v, tan_heading = self.road.in_tangent_frame(s, direction, around, own_d, d_prime)  # [L, K, ...]
        own_cos = torch.rsqrt(1 + tan_heading**2)
        own = Boxes(u, v, own_cos, tan_heading * own_cos, length / 2, width / 2)
        depth = overlap_depth(own, Boxes(torch.zeros_like(d), d, cos, sin, half_length, half_width))
        ends = [self._stretch(depth - slack, at) for slack in self.slacks_m]
        return torch.cat([*(first for first, _ in ends), *(last for _, last in ends)])

    def _stretch(self, depth: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
        """First and last blocked distance travelled [L, ...] (m), by the depths [L, K, ...] at the distances [K, ...].

        The depth changes by about one metre per metre at most, so a path is free for x metres from a place with depth
        -x. The stretch begins and ends there.
        """
        before, after = depth[:, :-1], depth[:, 1:]
        step = self.around[1] - self.around[0]
        entered = at[:-1] + torch.minimum((-before).clamp(min=0), step)
        left = at[1:] - torch.minimum((-after).clamp(min=0), step)
        first = torch.where(after > 0, entered, torch.inf).amin(1)
        return first, torch.where(before > 0, left, -torch.inf).amax(1)


def _like(example: Tensor, *values: Tensor | float) -> tuple[Tensor, ...]:
    """Values in the shape of an example; none is sent to a GPU, which a CUDA graph could not record."""
    return tuple(
        each.expand_as(example) if isinstance(each, Tensor) else torch.full_like(example, each) for each in values
    )
