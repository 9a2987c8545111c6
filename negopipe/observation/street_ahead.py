"""The street ahead of an agent as points on its route: free width, curvature, narrow places, places to pass.

The street does not change, so its features are tabulated once by way and place. A decision reads them from the table.
"""

import torch
from torch import Tensor

from negopipe.simulation.road import Road
from negopipe.simulation.waiting_place import Passage

KNOT_M = 0.5
"""Spacing of the table, m; between two knots it is linear."""

AROUND_M = 150.0
"""Reach of the table beyond the corridor, m: a start and the view ahead of it. Beyond its ends nothing changes."""

N_FEATURES = 5
"""Features of a place: free width to the left and to the right of the route (m), curvature of the line (1/m, positive
to the left), share of being in a narrow place, share of being where the other cannot pass (both 0 or 1, linear from
knot to knot)."""

BESIDE_M = 2.5
"""Reach of a footprint ahead and behind, m: a parked car bounds the free width within it."""

FAR_M = 1e4
"""Place of the cars that fill up streets with fewer of them, m."""


class StreetAhead:
    """Features of places on the routes of a road.

    passage: stretches of the road in which vehicles cannot pass each other
    """

    def __init__(self, road: Road, passage: Passage) -> None:
        self.road = road
        longest_m = float(road.narrow_places[..., 1].max())
        self._n_knots = 2 + int((longest_m + 2 * AROUND_M) / KNOT_M)
        self._table = tabulated(road, passage, self._n_knots, _parked(road))  # [2B K, N_FEATURES]

    def at(self, s: Tensor, direction: Tensor) -> Tensor:
        """[..., N_FEATURES] float32 at places s [...] (m) of vehicles that drive in `direction` [...]."""
        place = ((s + AROUND_M) * (1 / KNOT_M)).clamp(0.0, self._n_knots - 1.001)
        knot = torch.floor(place)
        index = self.road.way(direction) * self._n_knots + knot.long()
        before, after = self._table[index], self._table[index + 1]
        return before + (place - knot)[..., None] * (after - before)


def tabulated(road: Road, passage: Passage, n_knots: int, parked: Tensor) -> Tensor:
    """[2B K, N_FEATURES] at K knots of the ways; parked: [B, P, 4] m, sigma, d, length and width of cars."""
    s = -AROUND_M + KNOT_M * torch.arange(n_knots, device=road.device)
    way = road.ways[:, None].expand(-1, n_knots)
    return _features(road, passage, s.expand_as(way), way, parked).flatten(0, 1)


def _features(road: Road, passage: Passage, s: Tensor, way: Tensor, parked: Tensor) -> Tensor:
    """[2B, K, N_FEATURES] at places s [2B, K] of the ways [2B, K]."""
    left, right = free_sides(road, s, way, parked)
    offset = road.route_offset(s, way)[0]
    first, last = road.narrow_place(s, way)
    is_narrow = (s >= first) & (s <= last)
    length = passage.sizes.ego.length
    is_closed = (s > passage.waiting_s(s, way, length)) & (s < passage.leaving_s(s, way, length))
    curvature = road.curvature(s, way)[0]
    return torch.stack([left - offset, right + offset, curvature, is_narrow.float(), is_closed.float()], dim=-1)


def free_sides(road: Road, s: Tensor, way: Tensor, parked: Tensor) -> tuple[Tensor, Tensor]:
    """Free width to the left and to the right of the line at s [2B, K], seen by a driver, m: to kerb or parked car."""
    sigma, is_along = road.sigma(s, way), (road.sign(way) > 0).expand_as(s)
    right, left = road.kerbs_at(sigma, way)
    at, d, length, width = parked.repeat_interleave(2, 0).unbind(-1)  # [2B, P] each
    inner = d.abs() - width / 2
    is_beside = (sigma[..., None] - at[:, None]).abs() <= (length / 2 + BESIDE_M)[:, None]  # [2B, K, P]
    nearest = [
        torch.where(is_beside & is_there[:, None], inner[:, None], FAR_M).amin(-1) for is_there in (d > 0, d <= 0)
    ]
    left, right = torch.minimum(left, nearest[0]), torch.minimum(right, nearest[1])
    return torch.where(is_along, left, right), torch.where(is_along, right, left)


def _parked(road: Road) -> Tensor:
    """[B, P, 4] float32: sigma, d, length and width (m) of the cars parked on every street's road; P is at least 1."""
    nowhere = (FAR_M, 0.0, 0.0, 0.0)
    streets = [list(cars) for cars in road.parked_on_line]
    most = max(1, *map(len, streets))
    filled = [cars + [nowhere] * (most - len(cars)) for cars in streets]
    return torch.tensor(filled, dtype=torch.float32, device=road.device)
