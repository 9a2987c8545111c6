"""The reference line of the road, straight or with smooth bends: poses on it, and projections onto it.

sigma  arc length, m, with sigma = 0 in the corridor's middle, where the line passes the world's origin along +x
d      offset from the line to its left, m
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from negopipe.simulation.knot_tables import GAUSS, KNOT_M, N_SEARCHED
from negopipe.simulation.smoothstep import slope, smoothstep, step

REACH_M = 200.0
"""Bends lie within this distance from the corridor's middle; beyond it the line is straight."""

N_NEWTON = 3
"""Newton steps of a projection: from 1 m beside the foot on a bend of 20 m, two leave less than a rounding."""


@dataclass(frozen=True)
class Bend:
    """A bend of a line; `road_config.BendConfig` says what each value means."""

    start_m: float
    length_m: float
    angle_deg: float


class Course:
    """Heading and curvature of a line whose heading is a sum of smooth steps; methods take any shape, keep the dtype.

    is_straight: the line is the world's x axis (known before anything is computed)
    """

    def __init__(self, bends: Sequence[Bend]) -> None:
        turning = [bend for bend in bends if bend.angle_deg != 0]
        self.is_straight = not turning
        self._bends = [(bend.start_m, bend.length_m, math.radians(bend.angle_deg)) for bend in turning]
        self._heading_at_0 = 0.0
        self._heading_at_0 = float(self.heading(torch.zeros((), dtype=torch.float64)))

    def heading(self, sigma: Tensor) -> Tensor:
        """[...] rad, world; not wrapped."""
        heading = torch.full_like(sigma, -self._heading_at_0)
        for start, length, angle in self._bends:
            heading = heading + angle * step((sigma - start) / length)
        return heading

    def kappa(self, sigma: Tensor) -> Tensor:
        """[...] 1/m: the curvature alone."""
        kappa = torch.zeros_like(sigma)
        for start, length, angle in self._bends:
            kappa = kappa + (angle / length) * slope((sigma - start) / length)
        return kappa

    def curvature(self, sigma: Tensor) -> tuple[Tensor, Tensor]:
        """Curvature kappa [...] (1/m, positive to the left) and its derivative kappa' [...] (1/m2) by arc length."""
        kappa, kappa_prime = torch.zeros_like(sigma), torch.zeros_like(sigma)
        for start, length, angle in self._bends:
            _, first, second = smoothstep((sigma - start) / length)
            kappa = kappa + (angle / length) * first
            kappa_prime = kappa_prime + (angle / length**2) * second
        return kappa, kappa_prime


class ReferenceLine(Course):
    """A course with its positions, and projections onto it."""

    def __init__(self, bends: Sequence[Bend], device: torch.device | str = "cpu") -> None:
        super().__init__(bends)
        self._knots = self._tabulate().to(device)  # [2, K] float64, m, world
        self._searched = self._knots[:, ::N_SEARCHED].contiguous()

    def pose(self, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x, y (m) and heading (rad) of the line at sigma [...], world frame."""
        if self.is_straight:
            return sigma, torch.zeros_like(sigma), torch.zeros_like(sigma)
        knot = torch.floor((sigma + REACH_M) / KNOT_M).clamp(0, self._knots.shape[1] - 1)
        x, y = self._knots[:, knot.long()].to(sigma.dtype)
        from_m = knot * KNOT_M - REACH_M
        dx, dy = self._displacement(from_m, sigma - from_m)
        return x + dx, y + dy, self.heading(sigma)

    def place(self, sigma: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """x, y (m, world) of the points at an offset d from the line; the inverse of `project`."""
        if self.is_straight:
            return sigma, d
        x, y, heading = self.pose(sigma)
        return x - d * torch.sin(heading), y + d * torch.cos(heading)

    def project(self, x: Tensor, y: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """sigma, d [...] (m) of world positions x, y [...] (m): the foot of the perpendicular from the line.

        near: sigma within a few metres, where it is known; it saves the search for the nearest knot

        Newton's method on (p - r(sigma)) . t(sigma) = 0, whose derivative is -(1 - kappa d). That factor is kept
        from 0, which it only reaches at a bend's centre, far off any road.
        """
        if self.is_straight:
            return x, y
        sigma = self._nearest_knot(x, y) if near is None else near.expand_as(x)
        for _ in range(N_NEWTON):
            ahead, d = self._in_line_frame(sigma, x, y)
            sigma = sigma + ahead / (1 - self.kappa(sigma) * d).clamp(min=0.2)
        return sigma, self._in_line_frame(sigma, x, y)[1]

    def _nearest_knot(self, x: Tensor, y: Tensor) -> Tensor:
        """[...] m: sigma of the searched knot that is nearest to a position."""
        knot_x, knot_y = self._searched.to(x.dtype)
        nearest = ((x[..., None] - knot_x) ** 2 + (y[..., None] - knot_y) ** 2).argmin(-1)
        return nearest.to(x.dtype) * (N_SEARCHED * KNOT_M) - REACH_M

    def _in_line_frame(self, sigma: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Coordinates ahead and to the left [...] (m) of positions, in the frame of the line's pose at sigma."""
        line_x, line_y, heading = self.pose(sigma)
        cos, sin = torch.cos(heading), torch.sin(heading)
        dx, dy = x - line_x, y - line_y
        return dx * cos + dy * sin, dy * cos - dx * sin

    def _displacement(self, from_m: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Displacement x, y [...] (m) along the line from arc length `from_m` on; exact where it is straight."""
        dx, dy = torch.zeros_like(length), torch.zeros_like(length)
        for node, weight in GAUSS:
            heading = self.heading(from_m + node * length)
            dx, dy = dx + weight * torch.cos(heading), dy + weight * torch.sin(heading)
        return length * dx, length * dy

    def _tabulate(self) -> Tensor:
        """[2, K] float64, m: x, y of the knots, the middle one at the origin.

        The heading is integrated in pieces of 1/16 of the spacing: at the ends of a bend only its second derivative
        is continuous, which lowers the order of a quadrature rule.
        """
        n_pieces = 16
        n = round(2 * REACH_M / KNOT_M) * n_pieces
        piece = KNOT_M / n_pieces
        from_m = torch.arange(n, dtype=torch.float64) * piece - REACH_M
        steps = torch.stack(self._displacement(from_m, torch.full_like(from_m, piece)))
        knots = torch.cat([torch.zeros(2, 1, dtype=torch.float64), steps.cumsum(1)], dim=1)[:, ::n_pieces]
        return knots - knots[:, knots.shape[1] // 2, None]


def check_bends(bends: Sequence[Bend], width_m: float) -> None:
    """Raise ValueError unless a road of `width_m` along these bends is clear of its centres of curvature and of itself.

    Radii of at least the width keep 1 - kappa d above 1/2 on the road, and a line that turns by less than half a
    turn in all never meets itself.
    """
    for bend in bends:
        end = bend.start_m + bend.length_m
        if bend.start_m < -REACH_M or end > REACH_M:
            place = f"{bend.start_m:g} to {end:g} by start_m and length_m"
            raise ValueError(f"bends must lie within {REACH_M:g} m from the corridor, got {place}")
    line = Course(bends)
    if line.is_straight:
        return
    sigma = torch.cat([_places_in(bend) for bend in bends])  # outside all of them the line is straight
    sharpest = float(line.kappa(sigma).abs().max())
    if sharpest * width_m > 1:
        radius = f"{1 / sharpest:.3g} by length_m and angle_deg"
        raise ValueError(f"bends must have a radius of at least width_m {width_m:g}, got {radius}")
    heading = line.heading(sigma)
    turn_deg = math.degrees(float(heading.max() - heading.min()))
    if turn_deg >= 180:
        raise ValueError(f"bends must turn by less than 180 deg in all, got {turn_deg:.4g} by angle_deg")


def _places_in(bend: Bend) -> Tensor:
    """[K] float64 m: sigma from one end of a bend to the other, at most 0.1 m apart."""
    n = max(101, math.ceil(bend.length_m / 0.1) + 1)
    return bend.start_m + bend.length_m * torch.linspace(0, 1, n, dtype=torch.float64)
