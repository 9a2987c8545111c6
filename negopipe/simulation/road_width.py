"""Width of a drawn road along its line: a sum of smooth steps."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from negopipe.simulation.reference_line import REACH_M
from negopipe.simulation.smoothstep import smoothstep


@dataclass(frozen=True)
class WidthChange:
    """A change of a road's width; `road_config.WidthChangeConfig` says what each value means."""

    start_m: float
    length_m: float
    width_m: float

    @property
    def end_m(self) -> float:
        return self.start_m + self.length_m


def width_at(sigma: Tensor, first_m: float, changes: Sequence[WidthChange]) -> Tensor:
    """[...] m: distance from kerb to kerb at sigma [...]; before the changes it is `first_m`."""
    width, before_m = torch.full_like(sigma, first_m), first_m
    for change in changes:
        width = width + (change.width_m - before_m) * smoothstep((sigma - change.start_m) / change.length_m)[0]
        before_m = change.width_m
    return width


def check_width_changes(changes: Sequence[WidthChange], corridors_m: Sequence[tuple[float, float]]) -> None:
    """Raise ValueError unless they follow one another within reach, and the width is the same all along a corridor."""
    end_m = -REACH_M
    for change in changes:
        place = f"{change.start_m:g} to {change.end_m:g} by start_m and length_m"
        if change.start_m < -REACH_M or change.end_m > REACH_M:
            raise ValueError(f"width_changes must lie within {REACH_M:g} m from the corridor, got {place}")
        if change.start_m < end_m:
            raise ValueError(f"width_changes must follow one another, the one before ends at {end_m:g}, got {place}")
        for first, last in corridors_m:
            if change.start_m < last and change.end_m > first:
                raise ValueError(f"width_changes must lie outside the corridor {first:g} to {last:g}, got {place}")
        end_m = change.end_m
