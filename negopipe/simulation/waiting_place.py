"""Places before and behind the corridor at which a vehicle that stands on its route lets the others pass."""

from dataclasses import dataclass

import torch
from torch import Tensor

from negopipe.simulation.collisions import CollisionCheck
from negopipe.simulation.road import RouteState
from negopipe.tensors.tree import map_tensors

FARTHEST_M = 50.0
"""Length of the search for a waiting place, before or behind the corridor, m."""
STEP_M = 0.25
"""Spacing of the places that are tried, m."""


@dataclass(frozen=True)
class Passage:
    """The stretch of a street in which vehicles cannot pass each other, for both driving directions.

    waiting, leaving: [2] float32, m, s of the last place before it and of the first behind it at which the other can
        pass; against the line, along it
    """

    waiting: Tensor
    leaving: Tensor

    @staticmethod
    def of(collisions: CollisionCheck) -> "Passage":
        like = collisions.road.parked_cars
        waiting = [waiting_place(collisions, 0.0, direction) for direction in (-1.0, 1.0)]
        leaving = [leaving_place(collisions, direction) for direction in (-1.0, 1.0)]
        return Passage(like.new_tensor(waiting), like.new_tensor(leaving))

    def waiting_s(self, direction: Tensor) -> Tensor:
        """[...] m: of vehicles that drive in `direction` [...] (+1 or -1)."""
        return torch.where(direction > 0, self.waiting[1], self.waiting[0])

    def leaving_s(self, direction: Tensor) -> Tensor:
        """[...] m: of vehicles that drive in `direction` [...] (+1 or -1)."""
        return torch.where(direction > 0, self.leaving[1], self.leaving[0])


def waiting_place(collisions: CollisionCheck, latest_s_m: float, direction: float) -> float:
    """s (m) of the last place on the own route, `latest_s_m` at most, that the other can pass on its route.

    It is -inf where there is none within `FARTHEST_M`.
    """
    s = torch.arange(latest_s_m, -FARTHEST_M, -STEP_M, device=collisions.road.parked_cars.device)
    is_passable = _is_passable(collisions, s, direction)
    return float(s[is_passable].max()) if is_passable.any() else -torch.inf


def leaving_place(collisions: CollisionCheck, direction: float) -> float:
    """s (m) of the first place behind the corridor that the other can pass; inf where there is none."""
    length_m = collisions.road.config.corridor_length_m
    s = torch.arange(length_m, length_m + FARTHEST_M, STEP_M, device=collisions.road.parked_cars.device)
    is_passable = _is_passable(collisions, s, direction)
    return float(s[is_passable].min()) if is_passable.any() else torch.inf


def _is_passable(collisions: CollisionCheck, s: Tensor, direction: float) -> Tensor:
    """[K] bool: the other can pass a vehicle that stands on its route at s [K]."""
    road, own, zero = collisions.road, torch.full_like(s, direction), torch.zeros_like(s)
    standing = road.to_world(RouteState(s, zero, zero, *road.route_offset(s, own)), own)
    waiting = map_tensors(lambda field: field[:, None], standing)
    return ~collisions.stands_on_route(waiting, -own[:, None])[:, 0]
