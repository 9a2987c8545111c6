"""Vehicles lined up in parking areas and along a kerb."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from negopipe.maps.boxes import corners, overlap
from negopipe.maps.line import crossings, evenly
from negopipe.maps.street import STEP_M, Array, MapStreet, normals, to_line, to_plane
from negopipe.schema import Fraction, NonNegativeMetres, PositiveInterval, Seed, schema

BESIDE_M = 2.0
"""Largest distance of a parking area from the kerb that it lies beside."""
DENSE_M = 0.25
"""Distance of the places along the line at which an area's edges are measured."""


STRAIGHT_SHARE = 0.8
"""Share of an area's usual depth from which a place counts for the row's direction: slanted ends do not."""
TOLERANCE_M = 0.05
"""Length by which a vehicle may stick out of its area."""


class Side(StrEnum):
    """Side of a street, seen along its line."""

    LEFT = "left"
    RIGHT = "right"

    @property
    def sign(self) -> int:
        """1 on the left, -1 on the right: the sign of the offsets there."""
        return 1 if self is Side.LEFT else -1


@schema
class Parking:
    """How places for parked vehicles are drawn and filled.

    fill        share of the places that are taken
    seed        of the sizes, the gaps and the taken places
    length_m, width_m, gap_m    intervals of the vehicles' sizes and of the gaps between them
    """

    fill: Fraction
    seed: Seed
    length_m: PositiveInterval
    width_m: PositiveInterval
    gap_m: PositiveInterval


@schema
class KerbsideRow:
    """Row of parked vehicles on the road along a kerb, where the map has no parking area.

    side            of the street, seen along its line
    from_m, to_m    arc length along the line
    kerb_gap_m      between vehicles and kerb
    """

    side: Side
    from_m: NonNegativeMetres
    to_m: NonNegativeMetres
    kerb_gap_m: NonNegativeMetres


def park_in_areas(street: MapStreet, areas: list[Array], parking: Parking) -> Array:
    """Parked vehicles [P, 5] in the areas beside the street, polygons [N, 2] in the plane.

    Vehicles stand along the street; across it in areas at least as deep as the mean length of a vehicle.
    """
    random = np.random.default_rng(parking.seed)
    rows = [_in_area(street, area, parking, random) for area in areas]
    return np.concatenate([np.zeros((0, 5)), *rows])


def _in_area(street: MapStreet, area: Array, parking: Parking, random: np.random.Generator) -> Array:
    """Parked vehicles [P, 5] in one area; none where it does not lie beside the street."""
    ring = np.concatenate([area, area[:1]])
    sigma, d = to_line(street, evenly(ring, DENSE_M))
    sign = 1 if np.median(d) > 0 else -1
    low, high = max(sigma.min(), 0.0), min(sigma.max(), street.length_m)
    if high <= low or np.median(np.abs(d)) > 50:
        return np.zeros((0, 5))
    at = np.arange(low, high, DENSE_M)
    on_line, heading = to_plane(street, at, np.zeros_like(at))
    away = sign * crossings(on_line, normals(heading), ring)
    away = np.where(away > 0, away, np.nan)
    kerb = np.interp(at, street.sigma, street.left_m if sign > 0 else street.right_m)
    inside = (np.isfinite(away).sum(1) >= 2) & (np.nanmin(away, axis=1, initial=np.inf) - kerb < BESIDE_M)
    if not inside.any():
        return np.zeros((0, 5))
    near, far = np.full((2, len(at)), [[1.0], [0.0]])  # no room where the area is not
    near[inside], far[inside] = np.nanmin(away[inside], axis=1), np.nanmax(away[inside], axis=1)
    depth = float(np.median((far - near)[inside]))
    is_across = depth >= sum(parking.length_m) / 2
    straight = inside & (far - near > STRAIGHT_SHARE * depth)
    slope, height = np.polyfit(at[straight], ((near + far) / 2)[straight], 1) if straight.sum() > 1 else (0.0, depth)
    return _line_up(_Room(at, near, far, slope * at + height), sign, is_across, parking, random)


def park_along_kerb(street: MapStreet, row: KerbsideRow, parking: Parking, seed: int) -> Array:
    """Parked vehicles [P, 5] on the road along a kerb."""
    at = np.arange(row.from_m, min(row.to_m, street.length_m), DENSE_M)
    kerb = np.interp(at, street.sigma, street.left_m if row.side is Side.LEFT else street.right_m) - row.kerb_gap_m
    random = np.random.default_rng([parking.seed, seed])
    return _line_up(_Room(at, np.zeros_like(kerb), kerb, None), row.side.sign, False, parking, random)


@dataclass(frozen=True)
class _Room:
    """Room for a row of vehicles at arc lengths `at`, [N]: from the offsets `near` to `far` of the line.

    middle      offsets of the row's middle; None: the vehicles stand at `far`
    """

    at: Array
    near: Array
    far: Array
    middle: Array | None


def _line_up(room: _Room, sign: int, is_across: bool, parking: Parking, random: np.random.Generator) -> Array:
    """Vehicles [P, 5] one behind the other; a place that is too narrow is left out, of the others `fill` is taken."""
    places: list[tuple[float, float, float, float, float]] = []
    at = room.at
    begin = float(at[0]) if len(at) else np.inf
    while True:
        length, width, gap = (random.uniform(*sizes) for sizes in (parking.length_m, parking.width_m, parking.gap_m))
        along, deep = (width, length) if is_across else (length, width)
        if not begin + along <= at.max(initial=-np.inf):
            break
        beside = (at >= begin - DENSE_M) & (at <= begin + along + DENSE_M)
        offset, slope = _offset(room, beside, deep)
        if not np.isfinite(offset):
            begin += STEP_M
            continue
        yaw = sign * (np.arctan(slope) + (np.pi / 2 if is_across else 0.0))
        places.append((begin + along / 2, sign * offset, yaw, length, width))
        begin += along + gap
    taken = np.sort(random.permutation(len(places))[: round(parking.fill * len(places))])
    return np.array(places, dtype=np.float64).reshape(-1, 5)[taken]


def _offset(room: _Room, beside: NDArray[np.bool_], deep: float) -> tuple[float, float]:
    """Offset of the middle of a vehicle `deep` across the row, and the row's slope there; NaN where it does not fit."""
    near, far = room.near[beside], room.far[beside]
    middle = np.full_like(far, far.min() - deep / 2) if room.middle is None else room.middle[beside]
    fits = (middle - deep / 2 >= near - TOLERANCE_M).all() and (middle + deep / 2 <= far + TOLERANCE_M).all()
    slope = (middle[-1] - middle[0]) / (room.at[beside][-1] - room.at[beside][0])
    return (float(middle.mean()), float(slope)) if fits else (np.nan, 0.0)


def without_overlaps(street: MapStreet, parked: Array) -> Array:
    """Vehicles [P, 5] of which none overlaps an earlier one, ordered by arc length."""
    if not len(parked):
        return parked
    middle, heading = to_plane(street, parked[:, 0], parked[:, 1])
    shapes = corners(middle, heading + parked[:, 2], parked[:, 3:])
    kept: list[int] = []
    for index in range(len(parked)):
        if not (kept and overlap(shapes[index], shapes[kept]).any()):
            kept.append(index)
    chosen = parked[kept]
    return chosen[np.argsort(chosen[:, 0], kind="stable")]
