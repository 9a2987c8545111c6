"""Functions along many streets, looked up in tables of polynomials."""

import numpy as np
import torch
from torch import Tensor

from negopipe.simulation.knot_tables import GAUSS, KNOT_M, N_SEARCHED, Array, cubics, integrate, turned
from negopipe.simulation.reference_line import N_NEWTON
from negopipe.tensors.materialize import materialize


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
        cubic = cubics(kappa[0], kappa[1])
        self._curvature = Polynomials(cubic, device)
        self.at_knots = integrate(cubic)
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
        return self._at(sigma)[:3]

    def _at(self, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """x, y (m), heading (rad) and curvature (1/m) at sigma [...]."""
        (x, y, heading, *curvature), ahead = self._table._pose.at(self._street, sigma)
        dx, dy = torch.zeros_like(x), torch.zeros_like(x)
        for node, weight in GAUSS:
            between = heading + turned(curvature, node * ahead)
            dx, dy = dx + weight * torch.cos(between), dy + weight * torch.sin(between)
        a, b, c, d = curvature
        kappa = a + ahead * (b + ahead * (c + ahead * d))
        return x + ahead * dx, y + ahead * dy, heading + turned(curvature, ahead), kappa

    def place(self, sigma: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        x, y, heading = self.pose(sigma)
        return x - d * torch.sin(heading), y + d * torch.cos(heading)

    def project(self, x: Tensor, y: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor]:
        x, y = materialize(x, y)
        sigma = self._nearest_knot(x, y) if near is None else near.expand_as(x)
        for _ in range(N_NEWTON):
            ahead, d, kappa = self._in_line_frame(sigma, x, y)
            (sigma,) = materialize(sigma + ahead / (1 - kappa * d).clamp(min=0.2))
        sigma, d = materialize(sigma, self._in_line_frame(sigma, x, y)[1])
        return sigma, d

    def _nearest_knot(self, x: Tensor, y: Tensor) -> Tensor:
        """[...] m: sigma of the searched knot that is nearest to a position."""
        knot_x, knot_y = self._table._searched[self._street].unbind(-2)
        nearest = ((x[..., None] - knot_x) ** 2 + (y[..., None] - knot_y) ** 2).argmin(-1)
        return nearest.to(x.dtype) * (N_SEARCHED * KNOT_M) + self._table._first_m

    def _in_line_frame(self, sigma: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coordinates ahead and to the left [...] (m) in the frame of the line's pose at sigma, and its curvature."""
        line_x, line_y, heading, kappa = self._at(sigma)
        cos, sin = torch.cos(heading), torch.sin(heading)
        dx, dy = x - line_x, y - line_y
        return dx * cos + dy * sin, dy * cos - dx * sin, kappa
