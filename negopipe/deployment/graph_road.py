"""The road of an exported decision: one street whose tables are inputs, looked up in few nodes.

A node of a graph costs microseconds, more than what it computes for one vehicle. Places are therefore computed as rows
of one array: polynomials as sums over powers, the nodes of the quadrature together.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from negopipe.simulation.knot_tables import GAUSS, KNOT_M, N_SEARCHED
from negopipe.simulation.reference_line import N_NEWTON
from negopipe.simulation.street import Street
from negopipe.simulation.street_tables import Polynomials
from negopipe.simulation.streets import Streets

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

SMALL = 1024
"""Places up to which a polynomial is a sum over powers; of more, that takes longer than Horner's rule."""

N_DERIVATIVES = 3
"""Value, first and second derivative."""


class GatheredPolynomials(Polynomials):
    """Polynomials whose coefficients are looked up together."""

    def __init__(self, like: Polynomials) -> None:
        self._n_intervals, self._first_m, self._table = like._n_intervals, like._first_m, like._table
        self._derivatives = _derivatives(len(self._table))

    def at(self, row: Tensor, sigma: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        found, ahead = self.rows(row, sigma)
        return found.unbind(0), ahead

    def rows(self, row: Tensor | int, sigma: Tensor) -> tuple[Tensor, Tensor]:
        """Coefficients [n, ...] and the distance from the knot [...] (m)."""
        interval = torch.floor((sigma - self._first_m) * (1 / KNOT_M)).clamp(0, self._n_intervals - 1)
        ahead = sigma - (self._first_m + interval * KNOT_M)
        index = row * self._n_intervals + interval.long()
        return self._table.index_select(1, index.flatten()).reshape(-1, *index.shape), ahead

    def values(self, row: Tensor | int, sigma: Tensor) -> tuple[Tensor, ...]:
        """Value, first and second derivative at sigma [...]."""
        coefficients, ahead = self.rows(row, sigma)
        n = len(coefficients)
        powers = _powers(ahead.flatten(), 0, n)
        each = (self._derivatives @ coefficients.reshape(n, -1)).reshape(N_DERIVATIVES, n, -1)
        return tuple(field.reshape(ahead.shape) for field in (each * powers).sum(1))


class GraphLine:
    """The reference line, by the table of its poses and of its curvature."""

    def __init__(self, curvature: GatheredPolynomials, pose: GatheredPolynomials, searched: Tensor) -> None:
        """searched: [2, K], x, y of the knots at which a projection starts."""
        self._curvature, self._pose, self._searched = curvature, pose, searched
        self._shares = torch.tensor([*(node for node, _ in GAUSS), 1.0])[:, None, None]  # [J, 1, 1]
        self._weights = torch.tensor([[*(weight for _, weight in GAUSS), 0.0]])  # [1, J]
        self._integral = torch.tensor([1.0, 1 / 2, 1 / 3, 1 / 4])[:, None]

    def heading(self, sigma: Tensor) -> Tensor:
        return self._at(sigma)[2]

    def curvature(self, sigma: Tensor) -> tuple[Tensor, Tensor]:
        kappa, kappa_prime, _ = self._curvature.values(0, sigma)
        return kappa, kappa_prime

    def pose(self, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, y, heading, _, _, _ = self._at(sigma)
        return x, y, heading

    def place(self, sigma: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        x, y, _, cos, sin, _ = self._at(sigma)
        return x - d * sin, y + d * cos

    def project(self, x: Tensor, y: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor]:
        sigma = self._nearest_knot(x, y) if near is None else near.expand_as(x)
        for _ in range(N_NEWTON):
            ahead, d, kappa = self._in_line_frame(sigma, x, y)
            sigma = sigma + ahead / (1 - kappa * d).clamp(min=0.2)
        return sigma, self._in_line_frame(sigma, x, y)[1]

    def _nearest_knot(self, x: Tensor, y: Tensor) -> Tensor:
        knot_x, knot_y = self._searched
        nearest = ((x[..., None] - knot_x) ** 2 + (y[..., None] - knot_y) ** 2).argmin(-1)
        return nearest.to(x.dtype) * (N_SEARCHED * KNOT_M) + self._pose._first_m

    def _in_line_frame(self, sigma: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        line_x, line_y, _, cos, sin, kappa = self._at(sigma)
        dx, dy = x - line_x, y - line_y
        return dx * cos + dy * sin, dy * cos - dx * sin, kappa

    def _at(self, sigma: Tensor) -> tuple[Tensor, ...]:
        """x, y (m), heading (rad), its cosine and sine, and curvature (1/m) at sigma [...]."""
        shape = sigma.shape
        rows, ahead = self._pose.rows(0, sigma.flatten())
        place, start, cubic = rows[:2], rows[2:3], rows[3:]  # [2, k], [1, k], [4, k]
        powers = _powers(self._shares * ahead, 1, 5)  # [J, 4, k]
        headings = start + (powers * (cubic * self._integral)).sum(1)  # [J, k]
        cos, sin = torch.cos(headings), torch.sin(headings)
        place = place + ahead * torch.cat([self._weights @ cos, self._weights @ sin])
        kappa = (cubic * _powers(ahead, 0, 4)).sum(0)
        each = torch.cat([place, headings[-1:], cos[-1:], sin[-1:], kappa[None]])
        return tuple(field.reshape(shape) for field in each)


class BoundRoad(Streets):
    """One street whose tables are replaced: neither straight nor of even kerbs, as far as the code can tell."""

    def __init__(self, template: Street) -> None:
        super().__init__([template])
        self.is_straight = self._has_even_kerbs = False
        table = self._lines
        table._curvature, table._pose = GatheredPolynomials(table._curvature), GatheredPolynomials(table._pose)
        self._routes, self._kerbs = GatheredPolynomials(self._routes), GatheredPolynomials(self._kerbs)
        self._nearest_kerbs = GatheredPolynomials(self._nearest_kerbs)

    def bind(self, tables: Mapping[str, Tensor]) -> None:
        """Take over the tables of `StreetTables`, by name."""
        for name, table in tables.items():
            match name:
                case "line_curvature":
                    self._lines._curvature._table = table
                case "line_pose":
                    self._lines._pose._table = table
                case "line_points":
                    self._lines._searched = table[None]
                case "routes":
                    self._routes._table = table
                case "kerbs":
                    self._kerbs._table = table
                case "near_kerbs":
                    self._nearest_kerbs._table = table
                case "corridor":
                    self._corridor = table
                case "target":
                    self._target = table
                case "narrow_places" | "n_places" | "parked":
                    setattr(self, name, table)

    def line(self, direction: Tensor) -> GraphLine:
        table = self._lines
        assert isinstance(table._curvature, GatheredPolynomials)
        assert isinstance(table._pose, GatheredPolynomials)
        return GraphLine(table._curvature, table._pose, table._searched[0])

    def pick(self, table: Tensor, direction: Tensor) -> Tensor:
        return table[0]

    def way(self, direction: Tensor) -> Tensor:
        return (direction < 0).long()

    def route_offset(self, s: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if s.numel() > SMALL:
            return super().route_offset(s, direction)
        assert isinstance(self._routes, GatheredPolynomials)
        sign = self.sign(direction)
        value, first, second = self._routes.values(self.way(direction), self.sigma(s, direction))
        return sign * value, first, sign * second

    def _looked_up(self, kerbs: Polynomials, sigma: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        assert isinstance(kerbs, GatheredPolynomials)
        both = torch.arange(2).reshape(2, *[1] * sigma.dim())
        (value, slope), ahead = kerbs.rows(both, sigma)
        right, left = value + ahead * slope
        return right, left


def bound_road(config: "RunConfig") -> BoundRoad:
    """A road of the export's capacity; its tables are those of a straight street until it is bound."""
    capacity = config.export.capacity
    n, m = capacity.street.n_knots, capacity.n_narrow_places
    first = np.arange(m) * 2.0 - m + 0.5
    flat = np.zeros((n, 2))
    far = np.tile([1e4, 0.0, 0.0, 0.0], (capacity.n_parked, 1))
    narrow = np.stack([first, first + 1.0], -1)
    return BoundRoad(Street(flat, np.full((2, n), 10.0), np.zeros((2, n, 3)), far, narrow, 10.0))


def _powers(x: Tensor, first: int, end: int) -> Tensor:
    """[..., n, k]: powers from `first` to `end` - 1 of x [..., k] or [..., 1, k]."""
    exponents = torch.arange(first, end, dtype=torch.float32)[:, None]
    return torch.pow(x if x.dim() > 1 else x[None], exponents)


def _derivatives(n: int) -> Tensor:
    """[N_DERIVATIVES n, n]: coefficients of a polynomial -> those of its derivatives, one below the other."""
    once = torch.diag(torch.arange(1.0, n), 1)
    return torch.cat([torch.linalg.matrix_power(once, order) for order in range(N_DERIVATIVES)])
