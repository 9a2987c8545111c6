"""Street read from a map: reference line, kerbs and parked vehicles, the common result of all readers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers of a map, float64, m and rad."""

STEP_M = 0.5
"""Distance between neighbouring points of a reference line along its arc."""
LEAST_STRETCH = 0.2
"""Lower bound of `1 - curvature * d` on the road: below it the Frenet frame of the line comes near its singularity."""


@dataclass(frozen=True)
class MapStreet:
    """Street of K points on its reference line, `STEP_M` apart, and P parked vehicles.

    points      [K, 2]: x, y of the line, in the middle between the kerbs but smooth: heading and curvature are
                continuous and integrate to the points
    heading     [K]: direction of the line, continuous (not wrapped to a turn)
    curvature   [K]: 1/m, positive to the left, linear between the points
    left_m      [K]: distance of the left kerb from the line along its normal, positive
    right_m     [K]: distance of the right kerb, positive
    parked      [P, 5]: arc length from the first point, offset to the left, yaw relative to the line's tangent there,
                length, width; ordered by arc length
    name        name of the street, from the file
    source      where the map comes from: first line of the file SOURCE beside it, or empty
    licence     first line of the file LICENSE beside it, or empty
    """

    points: Array
    heading: Array
    curvature: Array
    left_m: Array
    right_m: Array
    parked: Array
    name: str
    source: str
    licence: str

    @property
    def length_m(self) -> float:
        """Arc length from the first to the last point."""
        return STEP_M * (len(self.points) - 1)

    @property
    def sigma(self) -> Array:
        """Arc length of every point, [K]."""
        return STEP_M * np.arange(len(self.points), dtype=np.float64)


def normals(heading: Array) -> Array:
    """Unit vectors to the left of the headings [...], [..., 2]."""
    return np.stack([-np.sin(heading), np.cos(heading)], axis=-1)


def to_plane(street: MapStreet, sigma: Array, d: Array) -> tuple[Array, Array]:
    """Positions [N, 2] and headings [N] of the line's frame at arc lengths `sigma` and offsets `d` to the left, [N].

    The line is taken as an arc around the nearest point, and continues as one before its first and behind its last.
    """
    nearest = np.clip(np.rint(sigma / STEP_M), 0, len(street.points) - 1).astype(np.int64)
    along = sigma - STEP_M * nearest
    turn = street.curvature[nearest] * along
    chord = street.heading[nearest] + turn / 2
    direction = np.stack([np.cos(chord), np.sin(chord)], axis=-1)
    on_line = street.points[nearest] + (along * np.sinc(turn / (2 * np.pi)))[:, None] * direction
    heading = street.heading[nearest] + turn
    return on_line + d[:, None] * normals(heading), heading


def to_line(street: MapStreet, positions: Array) -> tuple[Array, Array]:
    """Arc lengths and offsets to the left, [N] each, of the nearest place on the line to positions [N, 2].

    The line is taken as an arc around the nearest point, and continues as one before its first and behind its last.
    """
    distances = np.linalg.norm(positions[:, None] - street.points, axis=-1)
    nearest = distances.argmin(axis=1)
    offset = positions - street.points[nearest]
    heading, curvature = street.heading[nearest], street.curvature[nearest]
    along = offset[:, 0] * np.cos(heading) + offset[:, 1] * np.sin(heading)
    across = (offset * normals(heading)).sum(-1)
    turned = np.arctan2(curvature * along, 1 - curvature * across)
    straight = np.abs(curvature) < 1e-9
    safe = np.where(straight, 1.0, curvature)
    sigma = STEP_M * nearest + np.where(straight, along, turned / safe)
    radius = np.hypot(curvature * along, 1 - curvature * across)
    return sigma, np.where(straight, across, (1 - radius) / safe)


def free_sides(street: MapStreet) -> tuple[Array, Array]:
    """Free distance to the left and to the right of the line, [K] each: to the kerb or to a parked vehicle before it.

    A vehicle counts to the side on which its middle lies; one that reaches over the line leaves a negative distance on
    its side. Its box is measured in the line's frame, where the line's curvature over the box is neglected.
    """
    left, right = street.left_m.copy(), street.right_m.copy()
    for sigma, d, yaw, length, width in street.parked:
        along = (length * abs(np.cos(yaw)) + width * abs(np.sin(yaw))) / 2
        across = (length * abs(np.sin(yaw)) + width * abs(np.cos(yaw))) / 2
        beside = np.abs(street.sigma - sigma) <= along + STEP_M / 2
        side = left if d > 0 else right
        side[beside] = np.minimum(side[beside], abs(d) - across)
    return left, right
