"""Bays: rows of parked cars beside a drawn road, behind its kerbs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

BaySide = Literal["left", "right"]


@dataclass(frozen=True)
class Bay:
    """A row of parked cars; `road_config.BayConfig` says what each value means."""

    side: BaySide
    start_m: float
    length_m: float
    kerb_gap_m: float
    is_across: bool
    n_parked: int

    @property
    def end_m(self) -> float:
        return self.start_m + self.length_m

    def along_m(self, car_length_m: float, car_width_m: float) -> float:
        """Size of a car along the road."""
        return car_width_m if self.is_across else car_length_m


def park_in_bays(
    bays: Sequence[Bay], width_at: Callable[[Tensor], Tensor], car_length_m: float, car_width_m: float
) -> Tensor:
    """[P, 4] float32, sigma, d, length and width (m): cars evenly spread so that each row fills its bay.

    width_at: distance from kerb to kerb at sigma [...] float64; a row stands behind the kerb where that is farthest out
    """
    rows = [torch.zeros(0, 4)]
    for bay in bays:
        along_m = bay.along_m(car_length_m, car_width_m)
        across_m = car_length_m + car_width_m - along_m
        kerb_m = float(width_at(torch.linspace(bay.start_m, bay.end_m, 101, dtype=torch.float64)).max()) / 2
        first, last = bay.start_m + along_m / 2, bay.end_m - along_m / 2
        at = torch.linspace(first, last, bay.n_parked) if bay.n_parked > 1 else torch.tensor([(first + last) / 2])
        d = (1 if bay.side == "left" else -1) * (kerb_m + bay.kerb_gap_m + across_m / 2)
        rows.append(torch.cat([at[:, None], torch.tensor([d, along_m, across_m]).expand(len(at), 3)], dim=1))
    return torch.cat(rows)


def check_bays(bays: Sequence[Bay], car_length_m: float, car_width_m: float) -> None:
    """Raise ValueError unless the cars of each fit into it, and those of one side do not overlap."""
    for bay in bays:
        along_m = bay.along_m(car_length_m, car_width_m)
        if bay.n_parked * along_m > bay.length_m + 1e-6:
            raise ValueError(
                f"bays must be as long as their cars, got n_parked {bay.n_parked} of {along_m:g} m along the road "
                f"and length_m {bay.length_m:g}"
            )
    for side in ("left", "right"):
        for one, other in pairwise(sorted((bay for bay in bays if bay.side == side), key=lambda bay: bay.start_m)):
            if other.start_m < one.end_m - 1e-6:
                raise ValueError(
                    f"bays of one side must not overlap, one on the {side} ends at {one.end_m:g} by start_m and "
                    f"length_m, got another from {other.start_m:g}"
                )
