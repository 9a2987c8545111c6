"""Functions along many streets, looked up in tables of polynomials."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from negopipe.simulation.reference_line import GAUSS, KNOT_M, N_NEWTON, N_SEARCHED
from negopipe.tensors.materialize import materialize

Array = np.ndarray


class Polynomials:
    """Functions of sigma, one polynomial of degree n - 1 from each knot to the next.

    coefficients: [n, R, K - 1] float64, of powers of the distance from the knot (m), of R functions
    """

    def __init__(self, coefficients: Array, device: torch.device) -> None:
        self._n_intervals = coefficients.shape[2]
        self._first_m = -KNOT_M * self._n_intervals / 2
        self._table = torch.tensor(coefficients, dtype=torch.float32, device=device).flatten(1)

    def at(self, row: Tensor, sigma: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """Coefficients c_0 .. c_n-1 [...] of function `row` [...] (int64) at sigma [...], the distance from its knot.

        row and sigma broadcast.
        """
        interval = torch.floor((sigma - self._first_m) * (1 / KNOT_M)).clamp(0, self._n_intervals - 1)
        ahead = sigma - (self._first_m + interval * KNOT_M)
        index = row * self._n_intervals + interval.long()
        return tuple(coefficient[index] for coefficient in self._table), ahead


class LineTable:
    """The reference lines of B streets; `on` binds it to the streets of some vehicles.

    The curvature is a cubic from knot to knot. Heading and position are its integrals, so the three agree.
    """

    def __init__(self, curvature: Array, device: torch.device) -> None:
        """curvature: [B, K, 2] float64, kappa and kappa' at the knots, of which the middle one is the origin."""
        kappa = np.moveaxis(curvature, -1, 0)
        cubic = _cubics(kappa[0], kappa[1])
        self._curvature = Polynomials(cubic, device)
        self.at_knots = _integrate(cubic)
        x, y, heading = np.moveaxis(self.at_knots[:, :-1], -1, 0)
        self._pose = Polynomials(np.stack([x, y, heading, *cubic]), device)
        knots = torch.tensor(np.stack([x, y], 1)[:, :, ::N_SEARCHED], dtype=torch.float32, device=device)
        self._searched = knots  # [B, 2, K / 4]
        self._first_m = -KNOT_M * cubic.shape[2] / 2

    def on(self, street: Tensor) -> "BoundLine":
        """street: [...] int64."""
        return BoundLine(self, street)


class BoundLine:
    """The reference lines of the streets [...] of some vehicles; what is looked up broadcasts with them."""

    def __init__(self, table: LineTable, street: Tensor) -> None:
        self._table, self._street = table, street

    def heading(self, sigma: Tensor) -> Tensor:
        return self.pose(sigma)[2]

    def curvature(self, sigma: Tensor) -> tuple[Tensor, Tensor]:
        (a, b, c, d), ahead = self._table._curvature.at(self._street, sigma)
        kappa, kappa_prime = materialize(a + ahead * (b + ahead * (c + ahead * d)), b + ahead * (2 * c + 3 * ahead * d))
        return kappa, kappa_prime

    def pose(self, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x, y (m) and heading (rad) of the line at sigma [...], world frame."""
        (x, y, heading, *curvature), ahead = self._table._pose.at(self._street, sigma)
        dx, dy = torch.zeros_like(x), torch.zeros_like(x)
        for node, weight in GAUSS:
            between = heading + _turned(curvature, node * ahead)
            dx, dy = dx + weight * torch.cos(between), dy + weight * torch.sin(between)
        return x + ahead * dx, y + ahead * dy, heading + _turned(curvature, ahead)

    def place(self, sigma: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        x, y, heading = self.pose(sigma)
        return x - d * torch.sin(heading), y + d * torch.cos(heading)

    def project(self, x: Tensor, y: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor]:
        sigma = self._nearest_knot(x, y) if near is None else near.expand_as(x)
        for _ in range(N_NEWTON):
            ahead, d = self._in_line_frame(sigma, x, y)
            sigma = sigma + ahead / (1 - self.curvature(sigma)[0] * d).clamp(min=0.2)
        return sigma, self._in_line_frame(sigma, x, y)[1]

    def _nearest_knot(self, x: Tensor, y: Tensor) -> Tensor:
        """[...] m: sigma of the searched knot that is nearest to a position."""
        knot_x, knot_y = self._table._searched[self._street].unbind(-2)
        nearest = ((x[..., None] - knot_x) ** 2 + (y[..., None] - knot_y) ** 2).argmin(-1)
        return nearest.to(x.dtype) * (N_SEARCHED * KNOT_M) + self._table._first_m

    def _in_line_frame(self, sigma: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        line_x, line_y, heading = self.pose(sigma)
        cos, sin = torch.cos(heading), torch.sin(heading)
        dx, dy = x - line_x, y - line_y
        return dx * cos + dy * sin, dy * cos - dx * sin


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


def _cubics(value: Array, slope: Array) -> Array:
    """[4, B, K - 1]: cubics that have the values and slopes [B, K] at the knots."""
    h, rise = KNOT_M, np.diff(value, axis=1)
    before, after = slope[:, :-1], slope[:, 1:]
    second = (3 * rise / h - 2 * before - after) / h
    third = (before + after - 2 * rise / h) / h**2
    return np.stack([value[:, :-1], before, second, third])


def _turned(curvature: Any, ahead: Any) -> Any:
    """Turn of the line (rad) over the distance `ahead` (m) behind a knot."""
    a, b, c, d = curvature
    return ahead * (a + ahead * (b / 2 + ahead * (c / 3 + ahead * d / 4)))


def _integrate(cubic: Array) -> Array:
    """[B, K, 3]: x, y (m) and heading (rad) of the lines at the knots; the middle knot is the origin, along +x."""
    heading = _running(_turned(cubic, KNOT_M))
    middle = heading.shape[1] // 2
    heading = heading - heading[:, [middle]]
    steps = [np.zeros_like(heading[:, 1:]), np.zeros_like(heading[:, 1:])]
    for node, weight in GAUSS:
        between = heading[:, :-1] + _turned(cubic, node * KNOT_M)
        steps = [steps[0] + weight * KNOT_M * np.cos(between), steps[1] + weight * KNOT_M * np.sin(between)]
    x, y = (_running(step) for step in steps)
    return np.stack([x - x[:, [middle]], y - y[:, [middle]], heading], -1)


def _running(steps: Array) -> Array:
    """[B, K]: running sums of steps [B, K - 1], from 0 on."""
    return np.concatenate([np.zeros_like(steps[:, :1]), np.cumsum(steps, axis=1)], axis=1)
