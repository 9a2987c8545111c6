"""Chain of pieces made to a street: line, kerbs, parked vehicles, each checked."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from negopipe.errors import UserError
from negopipe.maps.chain import Piece
from negopipe.maps.line import middle_line
from negopipe.maps.parking import KerbsideRow, Parking, park_along_kerb, without_overlaps
from negopipe.maps.street import LEAST_STRETCH, STEP_M, Array, MapStreet
from negopipe.maps.xml_file import first_line_beside

SHORTEST_M = 40.0
"""Length that a street needs."""


def assemble(path: Path, name: str, chain: list[Piece]) -> MapStreet:
    """Street of a chain of pieces, without parked vehicles."""
    line, left_m, right_m = middle_line([piece.left for piece in chain], [piece.right for piece in chain])
    length_m = STEP_M * max(len(line.points) - 1, 0)
    if length_m < SHORTEST_M:
        raise UserError(
            f"{path}: its longest two-way street is {length_m:.1f} m long; at least {SHORTEST_M:g} m is needed"
        )
    holes = np.flatnonzero(~(np.isfinite(left_m) & np.isfinite(right_m)))
    if len(holes):
        raise UserError(
            f"{path}: a kerb is missing {STEP_M * holes[0]:.1f} m along the street; kerbs without holes are needed"
        )
    stretch = 1 - np.maximum(line.curvature * left_m, -line.curvature * right_m)
    if stretch.min() <= LEAST_STRETCH:
        where = STEP_M * int(stretch.argmin())
        radius = 1 / abs(line.curvature[stretch.argmin()])
        raise UserError(
            f"{path}: bends with a radius of {radius:.1f} m at {where:.1f} m along the street, too tight for it; "
            f"1 - curvature * d must stay above {LEAST_STRETCH:g} on the road"
        )
    source, licence = first_line_beside(path, "SOURCE"), first_line_beside(path, "LICENSE")
    nobody = np.zeros((0, 5))
    return MapStreet(line.points, line.heading, line.curvature, left_m, right_m, nobody, name, source, licence)


def with_parked(
    path: Path, street: MapStreet, parked: Array, rows: Sequence[KerbsideRow], parking: Parking
) -> MapStreet:
    """The street with the map's parked vehicles [P, 5] and rows of further ones along its kerbs."""
    groups = [parked]
    for index, row in enumerate(rows):
        if not row.from_m < row.to_m <= street.length_m:
            raise UserError(
                f"{path}: a row of parked vehicles reaches from {row.from_m:g} to {row.to_m:g} m; from < to <= "
                f"{street.length_m:g} m (the street's length) is allowed"
            )
        groups.append(park_along_kerb(street, row, parking, index))
    return replace(street, parked=without_overlaps(street, np.concatenate(groups)))
