"""Many streets in one batch: every world drives on its own."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from negopipe.simulation.geometry import Boxes, box_rows, rim
from negopipe.simulation.knot_tables import KNOT_M, lines, narrow_by_way, nearest_kerbs, quintics
from negopipe.simulation.off_road import off_road_rows
from negopipe.simulation.road import Line, Road
from negopipe.simulation.street import Street
from negopipe.simulation.street_tables import BoundLine, LineTable, Polynomials
from negopipe.tensors.materialize import materialize

FAR_M = 1e4
"""Coordinate of boxes that fill up the tables of streets with fewer of them, m."""


class StraightLine:
    """The world's x axis, the line of every straight street."""

    def heading(self, sigma: Tensor) -> Tensor:
        return torch.zeros_like(sigma)

    def curvature(self, sigma: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(sigma), torch.zeros_like(sigma)

    def pose(self, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return sigma, torch.zeros_like(sigma), torch.zeros_like(sigma)

    def place(self, sigma: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        return sigma, d

    def project(self, x: Tensor, y: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return x, y


class Streets(Road):
    """Streets by table; everything that is looked up broadcasts with `direction`.

    streets: the B streets, all with the same knots
    """

    def __init__(self, streets: Sequence[Street], device: torch.device | str = "cpu") -> None:
        self.streets, self.device = list(streets), torch.device(device)
        self.n_streets = len(streets)
        self.is_straight = all(street.is_straight for street in streets)
        self._has_even_kerbs = all(street.has_even_kerbs for street in streets)
        self._lines = LineTable(np.stack([street.curvature for street in streets]), self.device)
        self._routes = Polynomials(quintics(np.concatenate([street.routes for street in streets])), self.device)
        self._kerbs = Polynomials(lines(np.concatenate([street.kerbs for street in streets])), self.device)
        near = np.concatenate([nearest_kerbs(street.kerbs) for street in streets])
        self._nearest_kerbs = Polynomials(lines(near), self.device)
        self._half_width = self._tensor([street.kerbs[0, 0] for street in streets])  # [B], where kerbs are even
        lengths = [street.narrow[-1, 1] - street.narrow[0, 0] for street in streets]
        self._corridor = self._tensor(lengths)  # [B]
        self._target = self._tensor([length + street.target_m for length, street in zip(lengths, streets, strict=True)])
        self.n_places = torch.tensor([len(street.narrow) for street in streets], device=self.device)
        self.narrow_places = self._tensor(_narrow_places(streets))
        self.parked = box_rows(self._tensor(_padded(self._parked_in_world())))

    @cached_property
    def off_road(self) -> Tensor:
        kerbs = (street.kerbs for street in self.streets)
        return box_rows(self._tensor(_padded([*map(off_road_rows, self._lines.at_knots, kerbs)])))

    @property
    def reach_m(self) -> float:
        """Distance from the corridor's middle beyond which all streets are straight and empty, m."""
        return KNOT_M * (self.streets[0].kerbs.shape[1] - 1) / 2

    def line(self, direction: Tensor) -> Line:
        return StraightLine() if self.is_straight else self._lines.on(self._street(direction))

    def sign(self, direction: Tensor) -> Tensor:
        return torch.sign(direction)

    def pick(self, table: Tensor, direction: Tensor) -> Tensor:
        return table[self._street(direction)]

    def corridor_m(self, direction: Tensor) -> Tensor:
        return self.pick(self._corridor, direction)

    def target_s(self, direction: Tensor) -> Tensor:
        return self.pick(self._target, direction)

    @property
    def parked_on_line(self) -> list[list[tuple[float, float, float, float]]]:
        return [street.on_road for street in self.streets]

    def route_offset(self, s: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        sign = self.sign(direction)
        (a, b, c, d, e, f), x = self._routes.at(self.way(direction), self.sigma(s, direction))
        value = a + x * (b + x * (c + x * (d + x * (e + x * f))))
        first = b + x * (2 * c + x * (3 * d + x * (4 * e + x * (5 * f))))
        second = 2 * c + x * (6 * d + x * (12 * e + x * (20 * f)))
        d, d_prime, d_pprime = materialize(sign * value, first, sign * second)  # or every reader would look them up
        return d, d_prime, d_pprime

    def kerb_excess(self, s: Tensor, direction: Tensor, d: Tensor, reach: Tensor, sagitta: Tensor | float) -> Tensor:
        if self._has_even_kerbs:
            return d.abs() + reach + sagitta - self.pick(self._half_width, direction)
        right, left = self._looked_up(self._nearest_kerbs, self.sigma(s, direction), direction)
        offset = self.sign(direction) * d  # to the line's left
        return torch.maximum(offset - left, -offset - right) + reach + sagitta

    def is_off_road(self, boxes: Boxes, direction: Tensor | None = None) -> Tensor:
        direction = self._or_first(direction)
        if self.is_straight and self._has_even_kerbs:
            reach = boxes.half_length * boxes.sin.abs() + boxes.half_width * boxes.cos.abs()
            return boxes.y.abs() + reach > self.pick(self._half_width, direction)
        line = self.line(direction)
        middle, _ = line.project(boxes.x, boxes.y)
        sigma, d = line.project(*rim(boxes), near=middle)
        if self._has_even_kerbs:
            return d.abs().amax(0) > self.pick(self._half_width, direction)
        right, left = self.kerbs_at(sigma, direction)
        return torch.maximum(d - left, -d - right).amax(0) > 0

    def kerbs_at(self, sigma: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        return self._looked_up(self._kerbs, sigma, direction)

    def _looked_up(self, kerbs: Polynomials, sigma: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        row = 2 * self._street(direction)
        (right, right_slope), ahead = kerbs.at(row, sigma)
        (left, left_slope), _ = kerbs.at(row + 1, sigma)
        right, left = materialize(right + ahead * right_slope, left + ahead * left_slope)
        return right, left

    def _street(self, direction: Tensor) -> Tensor:
        """[...] int64: index of the street."""
        return direction.abs().long() - 1

    def _parked_in_world(self) -> list[np.ndarray]:
        """[P, 5] of every street: x, y, yaw, length and width of its parked cars, world frame."""
        n_parked = [len(street.parked) for street in self.streets]
        sigma, d, length, width = self._tensor(np.concatenate([street.parked for street in self.streets])).unbind(-1)
        street = torch.arange(self.n_streets).repeat_interleave(torch.tensor(n_parked)).to(self.device)
        line = BoundLine(self._lines, street)
        cars = torch.stack([*line.place(sigma, d), line.heading(sigma), length, width], -1).cpu()
        return [of_street.numpy() for of_street in cars.split(n_parked)]

    def _tensor(self, values: Sequence[float] | np.ndarray) -> Tensor:
        return torch.tensor(np.asarray(values), dtype=torch.float32, device=self.device)


def _padded(rows: Sequence[np.ndarray]) -> np.ndarray:
    """[B, N, 5]: the boxes of every street, and boxes of no size far away."""
    longest = max(map(len, rows))
    nowhere = np.array([FAR_M, FAR_M, 0.0, 0.0, 0.0])
    return np.stack([np.concatenate([row, np.tile(nowhere, (longest - len(row), 1))]) for row in rows])


def _narrow_places(streets: Sequence[Street]) -> np.ndarray:
    """[2B, M, 2], see `Road.narrow_places`."""
    longest = max(len(street.narrow) for street in streets)
    return np.concatenate([narrow_by_way(street.narrow, longest) for street in streets])
