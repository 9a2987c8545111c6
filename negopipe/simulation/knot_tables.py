"""Tables of a street at knots along its line, in NumPy alone, so that they are made where there is no torch.

sigma  arc length, m, with sigma = 0 in the middle knot
"""

import math
from typing import Any

import numpy as np

Array = np.ndarray

KNOT_M = 0.5
"""Spacing of the table of positions, m; from the nearest lower knot on, the heading is integrated."""

N_SEARCHED = 4
"""A projection starts at the nearest of every `N_SEARCHED`-th knot."""

GAUSS = ((0.5 - math.sqrt(0.15), 5 / 18), (0.5, 8 / 18), (0.5 + math.sqrt(0.15), 5 / 18))
"""Nodes and weights of the Gauss-Legendre rule on [0, 1], exact for polynomials of degree 5."""


BESIDE_M = 2.5
"""Reach of a footprint ahead and behind, m: a plan heeds the nearest kerbs within it where kerbs are uneven."""

BEYOND_M = 5.0
"""Length of the kerbs and tables of a street beyond everything that changes along it, m."""


def knots(reach_m: float) -> np.ndarray:
    """[K] float64, m: arc lengths every `KNOT_M` up to `reach_m` at least to both sides of 0; K is odd."""
    n = math.ceil(reach_m / KNOT_M)
    return KNOT_M * np.arange(-n, n + 1)


def quintics(values: Array) -> Array:
    """[6, R, K - 1]: polynomials that have the values [R, K, 3] (value, first, second derivative) at the knots."""
    start, end = values[:, :-1], values[:, 1:]
    h = KNOT_M
    c0, c1, c2 = start[..., 0], start[..., 1], start[..., 2] / 2
    rest = np.stack([end[..., 0] - c0 - c1 * h - c2 * h**2, end[..., 1] - c1 - 2 * c2 * h, end[..., 2] - 2 * c2])
    matrix = np.array([[h**3, h**4, h**5], [3 * h**2, 4 * h**3, 5 * h**4], [6 * h, 12 * h**2, 20 * h**3]])
    higher = np.einsum("ij,jrk->irk", np.linalg.inv(matrix), rest)
    higher[:, :, [0, -1]] = 0  # what goes on beyond the last knot must not grow
    return np.stack([c0, c1, c2, *higher])


def lines(values: Array) -> Array:
    """[2, R, K - 1]: straight lines between the values [R, K] at the knots."""
    return np.stack([values[:, :-1], np.diff(values, axis=1) / KNOT_M])


def cubics(value: Array, slope: Array) -> Array:
    """[4, B, K - 1]: cubics that have the values and slopes [B, K] at the knots."""
    h, rise = KNOT_M, np.diff(value, axis=1)
    before, after = slope[:, :-1], slope[:, 1:]
    second = (3 * rise / h - 2 * before - after) / h
    third = (before + after - 2 * rise / h) / h**2
    return np.stack([value[:, :-1], before, second, third])


def turned(curvature: Any, ahead: Any) -> Any:
    """Turn of the line (rad) over the distance `ahead` (m) behind a knot."""
    a, b, c, d = curvature
    return ahead * (a + ahead * (b / 2 + ahead * (c / 3 + ahead * d / 4)))


def integrate(cubic: Array) -> Array:
    """[B, K, 3]: x, y (m) and heading (rad) of the lines at the knots; the middle knot is the origin, along +x."""
    heading = _running(turned(cubic, KNOT_M))
    middle = heading.shape[1] // 2
    heading = heading - heading[:, [middle]]
    steps = [np.zeros_like(heading[:, 1:]), np.zeros_like(heading[:, 1:])]
    for node, weight in GAUSS:
        between = heading[:, :-1] + turned(cubic, node * KNOT_M)
        steps = [steps[0] + weight * KNOT_M * np.cos(between), steps[1] + weight * KNOT_M * np.sin(between)]
    x, y = (_running(step) for step in steps)
    return np.stack([x - x[:, [middle]], y - y[:, [middle]], heading], -1)


def _running(steps: Array) -> Array:
    """[B, K]: running sums of steps [B, K - 1], from 0 on."""
    return np.concatenate([np.zeros_like(steps[:, :1]), np.cumsum(steps, axis=1)], axis=1)


def nearest_kerbs(kerbs: Array) -> Array:
    """[2, K]: distances [2, K] of the kerbs, each the least within `BESIDE_M`."""
    n = round(BESIDE_M / KNOT_M)
    padded = np.pad(kerbs, ((0, 0), (n, n)), mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * n + 1, axis=1).min(-1)


def narrow_by_way(narrow: Array, n_places: int) -> Array:
    """[2, M, 2], m: first and last s of the narrow places [N, 2] (sigma), met along the line and against it.

    n_places: M, at least N; the last place is repeated
    """
    along = narrow - narrow[0, 0]
    against = narrow[-1, 1] - narrow[::-1, ::-1]
    filling = n_places - len(narrow)
    return np.stack([np.concatenate([way, np.tile(way[-1], (filling, 1))]) for way in (along, against)])
