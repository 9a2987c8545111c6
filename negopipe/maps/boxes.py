"""Oriented rectangles in the plane: corners and overlap."""

import numpy as np
from numpy.typing import NDArray

from negopipe.maps.street import Array, MapStreet, to_plane


def corners(middle: Array, heading: Array, size: Array) -> Array:
    """Corners [N, 4, 2] of rectangles with middles [N, 2], headings [N] and lengths and widths [N, 2]."""
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    local = signs * size[:, None]
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    turned = np.stack([cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]], axis=-1)
    return middle[:, None] + turned


def corners_of_parked(street: MapStreet) -> Array:
    """Corners of a street's parked vehicles in the plane, [P, 4, 2]."""
    sigma, d, yaw = street.parked[:, :3].T
    middle, heading = to_plane(street, sigma, d)
    return corners(middle, heading + yaw, street.parked[:, 3:])


def overlap(one: Array, others: Array) -> NDArray[np.bool_]:
    """Whether rectangle [4, 2] overlaps each of the others [N, 4, 2], by the separating axis theorem, [N]."""
    edges = np.concatenate(
        [np.broadcast_to(one[1:3] - one[:2], (len(others), 2, 2)), others[:, 1:3] - others[:, :2]], 1
    )
    axes = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
    mine = np.einsum("nad,cd->nac", axes, one)
    theirs = np.einsum("nad,ncd->nac", axes, others)
    apart = (mine.max(-1) <= theirs.min(-1)) | (theirs.max(-1) <= mine.min(-1))
    return np.asarray(~apart.any(-1))
