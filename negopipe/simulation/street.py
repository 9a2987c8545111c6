"""A street sampled at knots along its line: what `Streets` stacks into tables, and maps are read into."""

from dataclasses import dataclass

import numpy as np

from negopipe.simulation.knot_tables import KNOT_M

Array = np.ndarray

Car = tuple[float, float, float, float]
"""sigma, d, length and width of a parked car, m."""

ON_ROAD_M = 0.01
"""Width by which a car reaches over the kerb from which on it stands on the road, m."""


@dataclass(frozen=True)
class Street:
    """A street whose corridor has its middle at sigma = 0; float64, m, rad and 1/m.

    The knots lie at sigma = KNOT_M * (k - (K - 1) / 2), K is odd. From the first and the last knot on everything goes
    on as it is there, and the line straight on.

    curvature: [K, 2], kappa and kappa' of the line
    kerbs: [2, K], distance of the right and of the left kerb from the line
    routes: [2, K, 3], offset to the line's left, its first and its second derivative by sigma, of the route along the
        line and of the one against it
    parked: [P, 4], sigma, d, length and width of the parked cars, along the line's tangent
    narrow: [M, 2], first and last sigma of each narrow place, ascending; all together are the corridor
    target_m: distance beyond the corridor at which a vehicle has arrived
    """

    curvature: Array
    kerbs: Array
    routes: Array
    parked: Array
    narrow: Array
    target_m: float

    @property
    def is_straight(self) -> bool:
        return not self.curvature.any()

    @property
    def has_even_kerbs(self) -> bool:
        """Whether both kerbs are at one distance everywhere."""
        return bool((self.kerbs == self.kerbs[0, 0]).all())

    @property
    def on_road(self) -> list[Car]:
        """The parked cars that stand on the road, not beside it."""
        sigma = KNOT_M * (np.arange(self.kerbs.shape[1]) - (self.kerbs.shape[1] - 1) / 2)
        right, left = (np.interp(self.parked[:, 0], sigma, kerb) for kerb in self.kerbs)
        d, width = self.parked[:, 1], self.parked[:, 3]
        is_on_road = np.abs(d) - width / 2 < np.where(d > 0, left, right) - ON_ROAD_M
        return [(at, offset, length, across) for at, offset, length, across in self.parked[is_on_road].tolist()]
