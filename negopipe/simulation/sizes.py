"""Sizes of the vehicles of a scenario: bounds of all of them, and one size where all are alike."""

from dataclasses import dataclass

from torch import Tensor

from negopipe.simulation.geometry import Size


@dataclass(frozen=True)
class Sizes:
    """Sizes of the vehicles of a scenario; all numbers are floats, m.

    ego: of the ego. Places that are laid down for a centre (waiting places, the planner's stops) are those of a vehicle
        of this length; a longer one has its front there, or its rear where it leaves
    smallest, largest: bounds of the lengths and widths of all vehicles
    """

    ego: Size
    smallest: Size
    largest: Size

    @property
    def is_one(self) -> bool:
        """Whether all vehicles are alike."""
        return self.smallest == self.largest

    def of(self, length: Tensor, width: Tensor) -> Size:
        """Size of vehicles with lengths and widths [...] (m); floats where all are alike, which costs less."""
        return self.ego if self.is_one else Size(length, width)

    def longer_m(self, length: Tensor | float) -> Tensor | float:
        """Half of what vehicles of a length are longer than the ego, [...] m: how far their front is farther ahead."""
        return 0.0 if self.is_one else (length - self.ego.length) / 2
