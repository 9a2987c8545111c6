"""The area beyond the kerbs as rectangles: two on a straight road, a fan of strips along a bent one."""

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.simulation.geometry import Boxes
from negopipe.simulation.reference_line import ReferenceLine

STRIP_M = 1000.0
"""Length of a strip along a straight kerb, m: longer than any view."""

DEPTH_M = 60.0
"""Largest depth of a strip, m: how far a view reaches straight on where the road bends away."""

SAGITTA_M = 0.03
"""Largest distance of a strip's straight edge from its bent kerb, m: a fifth of the grid's narrowest cell."""

SAMPLE_M = 0.1
"""Spacing of the kerb points from which strips are computed, m."""

LONGEST_M = 12.0
"""Largest length of a strip between two bends, m."""


class _Kerb(NamedTuple):
    """Points [K] of one kerb: arc length sigma of the line, x, y, and the line's heading; float64, m, rad, world."""

    sigma: Tensor
    x: Tensor
    y: Tensor
    heading: Tensor


def off_road_boxes(line: ReferenceLine, width_m: float, device: torch.device | str) -> Boxes:
    """Rectangles (fields [R], world frame) that together cover the area beyond the kerbs, and no road.

    On a bent road they are exact to `SAGITTA_M` at the kerb and reach `DEPTH_M` beyond it.
    """
    if line.is_straight:
        middle = (width_m + STRIP_M) / 2
        rows = [(0.0, side * middle, 0.0, STRIP_M, STRIP_M) for side in (-1, 1)]
    else:
        cuts = _cut(line, width_m)
        sigma = torch.arange(
            cuts[0] - 2 * DEPTH_M, cuts[-1] + 2 * DEPTH_M, SAMPLE_M, dtype=torch.float64, device=device
        )
        kerbs = {side: _kerb(line, sigma, side * width_m / 2) for side in (-1, 1)}
        ranges = [(-math.inf, cuts[0]), *pairwise(cuts), (cuts[-1], math.inf)]
        rows = [_strip(kerbs, side, first, last) for side in (-1, 1) for first, last in ranges]
    x, y, yaw, length, width = torch.tensor(rows, device=device).unbind(-1)
    return Boxes(x, y, torch.cos(yaw), torch.sin(yaw), length / 2, width / 2)


def _cut(line: ReferenceLine, width_m: float) -> list[float]:
    """Arc lengths (m) at which strips meet; each strip is as long as the sagitta of its outer kerb allows."""
    first, last = line.bent_m
    sigma = torch.arange(first, last, SAMPLE_M, dtype=torch.float64)
    curvature = line.curvature(sigma)[0].abs()
    kerb_per_line = 1 + float(curvature.max()) * width_m / 2  # metres of the outer kerb per metre of the line
    cuts, start = [first], 0
    for index in range(1, len(sigma)):
        length = (index + 1 - start) * SAMPLE_M
        sagitta = float(curvature[start : index + 1].max()) * kerb_per_line * length**2 / 8
        if sagitta > SAGITTA_M or length > LONGEST_M:
            cuts.append(float(sigma[index]))
            start = index
    return [*cuts, last]


def _kerb(line: ReferenceLine, sigma: Tensor, d: float) -> _Kerb:
    x, y = line.place(sigma, torch.full_like(sigma, d))
    return _Kerb(sigma, x, y, line.heading(sigma))


def _strip(kerbs: dict[int, _Kerb], side: int, first: float, last: float) -> tuple[float, float, float, float, float]:
    """x, y, yaw, length, width of the rectangle beyond one kerb (side +1 left, -1 right) from sigma first to last.

    The rectangle lies along the tangent in the middle of its piece of kerb. It is longer than the piece where the
    normals of the kerb fan out. Its near edge lies beyond all points of its kerb, its far edge before any other kerb.
    """
    kerb = kerbs[side]
    is_piece = (kerb.sigma >= first - SAMPLE_M) & (kerb.sigma <= last + SAMPLE_M)
    piece = _Kerb(*(field[is_piece] for field in kerb))
    origin = len(piece.sigma) // 2
    x, y, yaw = float(piece.x[origin]), float(piece.y[origin]), float(piece.heading[origin])
    u, _ = _in_frame(piece, x, y, yaw, side)
    turn = side * (piece.heading - piece.heading[origin])
    fan = DEPTH_M * torch.tan(turn.abs().clamp(max=1.0))
    back, ahead = u.min(), u.max()
    back = back - torch.where((u < 0) & (turn > 0), fan, 0.0).max()
    ahead = ahead + torch.where((u > 0) & (turn < 0), fan, 0.0).max()
    edge, depth = _edge_and_depth(kerbs, side, (x, y, yaw), (float(back), float(ahead)), piece)
    if math.isinf(first):
        back = ahead - STRIP_M
    if math.isinf(last):
        ahead = back + STRIP_M
    along, across = float(back + ahead) / 2, side * (edge + depth / 2)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return x + along * cos - across * sin, y + along * sin + across * cos, yaw, float(ahead - back), depth


def _edge_and_depth(
    kerbs: dict[int, _Kerb], side: int, pose: tuple[float, float, float], reach: tuple[float, float], piece: _Kerb
) -> tuple[float, float]:
    """Distance beyond the kerb at which a rectangle may begin, and its depth, both m.

    pose: frame (x, y, yaw) of the rectangle; reach: its first and last coordinate along that frame, m
    """
    low, high = reach[0] - SAMPLE_M, reach[1] + SAMPLE_M
    middle = float(piece.sigma[0] + piece.sigma[-1]) / 2
    nearby = float(piece.sigma[-1] - piece.sigma[0]) / 2 + (reach[1] - reach[0])
    edge, ends = 0.0, []
    for other, kerb in kerbs.items():
        u, v = _in_frame(kerb, *pose, side)
        is_beside = (u >= low) & (u <= high)
        is_own = is_beside & ((kerb.sigma - middle).abs() <= nearby) & (other == side)
        if is_own.any():
            edge = max(edge, float(v[is_own].max()))
        ends.append(v[is_beside & ~is_own])
    beyond = torch.cat(ends)
    beyond = beyond[beyond > edge]
    depth = min(DEPTH_M, float(beyond.min()) - SAMPLE_M - edge) if len(beyond) else DEPTH_M
    return edge, max(depth, SAMPLE_M)


def _in_frame(points: _Kerb, x: float, y: float, yaw: float, side: int) -> tuple[Tensor, Tensor]:
    """Coordinates u ahead and v towards the off-road side [K] (m) of points, in the frame of a pose in the world."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    dx, dy = points.x - x, points.y - y
    return dx * cos + dy * sin, side * (dy * cos - dx * sin)
