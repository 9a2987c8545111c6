"""Check of planned footprints against what stands beside the road: kerbs and parked cars."""

from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.planner.parked_rows import NO_ROW, parked_rows
from negopipe.simulation.geometry import Size
from negopipe.simulation.road import Road
from negopipe.simulation.sizes import Sizes
from negopipe.tensors.materialize import materialize


class ParkedRow(NamedTuple):
    """Parked cars beside the reference line, without room for a vehicle between them.

    sigma, half_length: m, arc length of the middle of the row, and half the row's length
    side: +1 to the left of the line, -1 to the right
    inner: m, distance from the line to the row's side that faces the road, positive towards `side`

    Every field is a tensor [N], of the vehicles that plan; of one street [].
    """

    sigma: Tensor
    half_length: Tensor
    side: Tensor
    inner: Tensor


class Half(NamedTuple):
    """Half lengths and half widths of footprints with their clearance, [S, N] or, of one size, [S, 1]; m."""

    length: Tensor
    width: Tensor


class Roadside:
    """Check of footprints, grown by clearances, against kerbs and parked cars.

    No vehicle fits between a parked car and its kerb, so a footprint is clear of the car if, all along the car, the
    footprint's border lies on the road's side of the car's inner side.

    clearance_m: [S] m, one for every station at which a path is checked
    """

    def __init__(self, road: Road, sizes: Sizes, clearance_m: Tensor) -> None:
        self.road = road
        self.clearance_m = clearance_m[:, None]  # [S, 1]
        self._one = self._half(sizes.ego) if sizes.is_one else None  # stored once: the planner's innermost loop
        room_m = float(sizes.smallest.width) + 2 * float(clearance_m.min())
        rows = [parked_rows(cars, road.is_straight, room_m) for cars in road.parked_on_line]
        self.n_rows = max(map(len, rows))
        self._rows = torch.tensor([[*each, *[NO_ROW] * (self.n_rows - len(each))] for each in rows])
        self._rows = self._rows.to(road.device)  # [B, P, 4]

    def excess(self, s: Tensor, direction: Tensor, d: Tensor, d_prime: Tensor, size: Size) -> Tensor:
        """[L, S, N] m: depth by which a footprint reaches over a kerb or into a parked car, negative where it is clear.

        s: [S, N] m; direction: [N]; d, d_prime: [L, S, N] m and 1, the offset and its derivative by s
        size: of the vehicles, [N] or floats
        """
        half = self._half(size) if self._one is None else self._one
        return torch.maximum(
            self._over_kerb(s, direction, d, d_prime, half), self._into_rows(s, direction, d, d_prime, half)
        )

    def _half(self, size: Size) -> Half:
        return Half(size.length / 2 + self.clearance_m, size.width / 2 + self.clearance_m)

    def rows(self, direction: Tensor) -> list[ParkedRow]:
        """The rows of the street of each vehicle; direction: [N]."""
        rows = self.road.pick(self._rows, direction)  # [N, P, 4], of one street [P, 4]
        if rows.dim() == 3:
            rows = torch.stack(materialize(*rows.flatten(1).unbind(-1))).unflatten(0, (-1, 4)).movedim(-1, 0)
        return [ParkedRow(*row.unbind(-1)) for row in rows.unbind(-2)]

    def _over_kerb(self, s: Tensor, direction: Tensor, d: Tensor, d_prime: Tensor, half: Half) -> Tensor:
        sagitta: Tensor | float = 0.0  # how far a curved kerb reaches towards the middle of a straight side
        tan_heading = d_prime
        if not self.road.is_straight:
            kappa, _ = self.road.curvature(s, direction)
            sagitta = kappa.abs() * half.length**2 / 2
            tan_heading = d_prime / (1 - kappa * d)
        cos = torch.rsqrt(1 + tan_heading**2)
        reach = half.length * tan_heading.abs() * cos + half.width * cos
        return self.road.kerb_excess(s, direction, d, reach, sagitta)

    def _into_rows(self, s: Tensor, direction: Tensor, d: Tensor, d_prime: Tensor, half: Half) -> Tensor:
        """[L, S, N] m: largest depth by which a footprint reaches into a row."""
        depths = [self._into_row(row, s, direction, d, d_prime, half) for row in self.rows(direction)]
        return reduce(torch.maximum, depths)

    def _into_row(self, row: ParkedRow, s: Tensor, direction: Tensor, d: Tensor, d_prime: Tensor, half: Half) -> Tensor:
        """[L, S, N] m: depth by which a footprint reaches into a row.

        The row is taken to be on the left and the nose to be turned left; other cases are mirrored across or along.
        The corner that reaches farthest is at (corner, height). From there the border falls along the long side to the
        rear and along the short side to the front.
        """
        sign = self.road.sign(direction)
        at = sign * row.sigma + self.road.corridor_m(direction) / 2
        u, v, tan_heading = self.road.in_tangent_frame(at, direction, s - at, d, d_prime)
        side = row.side * sign
        turned = tan_heading * side
        steep = turned.abs().clamp(min=1e-4)
        cos = torch.rsqrt(1 + steep**2)
        sin = steep * cos
        ahead = torch.where(turned < 0, u, -u)  # of the row's middle, from the footprint's
        corner = half.length * cos - half.width * sin
        nearest = (corner - ahead).clamp(-row.half_length, row.half_length) + ahead - corner
        height = half.length * sin + half.width * cos - torch.maximum(-steep * nearest, nearest / steep)
        alongside = row.half_length + half.length * cos + half.width * sin - ahead.abs()
        return torch.minimum(v * side + height - row.inner, alongside)
