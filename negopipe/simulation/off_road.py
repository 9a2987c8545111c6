"""The area beyond the kerbs as rectangles: two on a straight road, a fan of strips along a bent kerb."""

import numpy as np

STRIP_M = 1000.0
"""Length of a strip along a straight kerb, m: longer than any view."""

DEPTH_M = 60.0
"""Largest depth of a strip, m: how far a view reaches straight on where the road bends away."""

SAGITTA_M = 0.03
"""Largest distance of a strip's straight edge from its bent kerb, m: a fifth of the grid's narrowest cell."""

LONGEST_M = 12.0
"""Largest length of a strip between two bends, m."""

CLEAR_M = 0.1
"""Distance by which a strip's far edge keeps away from another kerb, m."""

STRAIGHT_RAD = 1e-9
"""Largest turn of a straight kerb, rad."""

Array = np.ndarray


def off_road_rows(line: Array, kerbs: Array) -> Array:
    """[R, 5], x, y, yaw, length and width: rectangles that together cover the area beyond the kerbs, and no road.

    They are exact to `SAGITTA_M` at the kerb and reach `DEPTH_M` beyond it.

    line: [K, 3], x, y and heading of the reference line, which goes straight on at both ends; m, rad, world frame
    kerbs: [2, K], distance of the right and of the left kerb from the line, m
    """
    if np.ptp(line[:, 2]) < STRAIGHT_RAD and np.ptp(kerbs, axis=1).max() == 0:
        return _two_boxes(line, kerbs[:, 0])
    sides = np.array([-1.0, 1.0])
    d = sides[:, None] * kerbs
    points = np.stack([line[:, 0] - d * np.sin(line[:, 2]), line[:, 1] + d * np.cos(line[:, 2])], -1)  # [2, K, 2]
    steps = np.gradient(points, axis=1)
    heading = np.unwrap(np.arctan2(steps[..., 1], steps[..., 0]), axis=1)
    return np.concatenate([_strips(points, heading[side], side, sides[side]) for side in (0, 1)])


def _two_boxes(line: Array, kerb_m: Array) -> Array:
    """One rectangle beyond each straight kerb; kerb_m: [2], distance of the right and of the left one."""
    x, y, yaw = line[len(line) // 2]
    d = np.array([-1.0, 1.0]) * (kerb_m + STRIP_M / 2)
    size = np.full(2, STRIP_M)
    return np.stack([x - d * np.sin(yaw), y + d * np.cos(yaw), np.full(2, yaw), size, size], -1)


def _cut(points: Array, heading: Array) -> list[int]:
    """Indices of the points at which strips meet; each strip is as long as the sagitta of its kerb allows."""
    length = np.hypot(*np.diff(points, axis=0).T)
    turn = np.abs(np.diff(heading))
    bent = np.flatnonzero(turn > STRAIGHT_RAD)
    if len(bent) == 0:
        return [len(heading) // 2]
    steps, curvature = length.tolist(), (turn / length).tolist()
    start, last = int(bent[0]), int(bent[-1]) + 1
    cuts, reached_m, sharpest = [start], 0.0, 0.0
    for index in range(start, last):
        reached_m, sharpest = reached_m + steps[index], max(sharpest, curvature[index])
        if index > cuts[-1] and (sharpest * reached_m**2 / 8 > SAGITTA_M or reached_m > LONGEST_M):
            cuts.append(index)
            reached_m, sharpest = steps[index], curvature[index]
    return [*cuts, last]


def _strips(points: Array, heading: Array, own: int, side: float) -> Array:
    """[R, 5]: the strips of the kerb `own`, an index of points [2, K, 2]; side: +1 left of the line, -1 right of it.

    A strip lies along the tangent in the middle of its piece of kerb. It is longer than the piece where the normals of
    the kerb fan out. Its near edge lies beyond all points of its kerb, its far edge before any other kerb.
    """
    n = len(heading)
    cuts = _cut(points[own], heading)
    first, last = np.array([0, *cuts]), np.array([*cuts, n - 1])  # [R]
    origin = (first + last) // 2
    at, yaw = points[own, origin], heading[origin]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    away = points.reshape(1, -1, 2) - at[:, None]  # [R, 2K, 2]
    u = away[..., 0] * cos + away[..., 1] * sin
    v = side * (away[..., 1] * cos - away[..., 0] * sin)
    index = np.arange(n)
    is_piece = (index >= first[:, None]) & (index <= last[:, None])  # [R, K]
    own_u = u[:, own * n : (own + 1) * n]
    turn = side * (heading - yaw[:, None])
    fan = DEPTH_M * np.tan(np.minimum(np.abs(turn), 1.0))
    back = np.where(is_piece, own_u, np.inf).min(1) - np.where(is_piece & (own_u < 0) & (turn > 0), fan, 0.0).max(1)
    ahead = np.where(is_piece, own_u, -np.inf).max(1) + np.where(is_piece & (own_u > 0) & (turn < 0), fan, 0.0).max(1)
    edge, depth = _edge_and_depth(u, v, (back, ahead), is_piece, own, points[own])
    back[0], ahead[-1] = ahead[0] - STRIP_M, back[-1] + STRIP_M
    along, across = (back + ahead) / 2, side * (edge + depth / 2)
    x = at[:, 0] + along * cos[:, 0] - across * sin[:, 0]
    y = at[:, 1] + along * sin[:, 0] + across * cos[:, 0]
    return np.stack([x, y, yaw, ahead - back, depth], -1)


def _edge_and_depth(
    u: Array, v: Array, reach: tuple[Array, Array], is_piece: Array, own: int, own_points: Array
) -> tuple[Array, Array]:
    """Distance beyond the kerb at which the rectangles may begin, and their depth, both [R] m.

    u, v: [R, 2K], coordinates of all kerb points, ahead and towards the off-road side
    reach: first and last coordinate of the rectangles, [R]
    is_piece: [R, K], the points of a rectangle's own piece of kerb
    """
    n = is_piece.shape[1]
    is_beside = (u >= reach[0][:, None]) & (u <= reach[1][:, None])
    is_own = np.zeros_like(is_beside)
    n_piece = is_piece.sum(1)
    n_near = n_piece / 2 + (reach[1] - reach[0]) / np.hypot(*np.diff(own_points, axis=0).T).min()
    is_near = np.abs(np.arange(n) - (is_piece.argmax(1) + n_piece // 2)[:, None]) <= n_near[:, None]
    is_own[:, own * n : (own + 1) * n] = is_beside[:, own * n : (own + 1) * n] & is_near
    edge = np.maximum(np.where(is_own, v, 0.0).max(1), 0.0)
    beyond = np.where(is_beside & ~is_own & (v > edge[:, None]), v, np.inf).min(1)
    return edge, np.maximum(np.minimum(DEPTH_M, beyond - CLEAR_M - edge), CLEAR_M)
