"""Places before and behind a narrow place at which a vehicle that stands on its route lets the others pass."""

from dataclasses import dataclass

import torch
from torch import Tensor

from negopipe.simulation.collisions import CollisionCheck
from negopipe.simulation.geometry import Size
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.sizes import Sizes
from negopipe.tensors.tree import map_tensors

FARTHEST_M = 50.0
"""Length of the search for a waiting place, before or behind a narrow place, m."""
STEP_M = 0.25
"""Spacing of the places that are tried, m."""
ROOM_M = 0.45
"""Room that who waits leaves on either side of the vehicle that passes, m. With the least room nobody who plans gets
past on the street one_sided (docs/planner.md)."""


@dataclass(frozen=True)
class Passage:
    """The stretches of a road in which vehicles cannot pass each other, one around each narrow place.

    A vehicle at s is in one, or comes to it next. All fields are [2B, M] float32, m, by way (`Road.way`) and narrow
    place, in the order in which a vehicle meets them.

    waiting, leaving: s of the last place before the narrow place and of the first behind it at which the other can
        pass. It is that of the centre of a vehicle as long as the ego: a longer one has its front, or its rear, there
    their_waiting, their_leaving: the same of an oncoming vehicle, on its own route
    """

    road: Road
    sizes: Sizes
    waiting: Tensor
    leaving: Tensor
    their_waiting: Tensor
    their_leaving: Tensor

    @staticmethod
    def of(collisions: CollisionCheck, sizes: Sizes) -> "Passage":
        waiting, leaving = waiting_places(collisions, sizes, 0.0, ROOM_M), _leaving_places(collisions, sizes)
        theirs = (collisions.road.seen_by_oncoming(each) for each in (waiting, leaving))
        return Passage(collisions.road, sizes, waiting, leaving, *theirs)

    def waiting_s(self, s: Tensor, direction: Tensor, length: Tensor | float) -> Tensor:
        """[...] m: `waiting` of vehicles of a length that drive in `direction` [...] and are at s [...]."""
        return self._at(self.waiting, s, direction) - self.sizes.longer_m(length)

    def leaving_s(self, s: Tensor, direction: Tensor, length: Tensor | float) -> Tensor:
        """[...] m: `leaving` of vehicles of a length that drive in `direction` [...] and are at s [...]."""
        return self._at(self.leaving, s, direction) + self.sizes.longer_m(length)

    def their_waiting_s(self, s: Tensor, direction: Tensor, their_length: Tensor | float) -> Tensor:
        """[...] m: `their_waiting` of oncoming vehicles of a length, for vehicles at s [...]."""
        return self._at(self.their_waiting, s, direction) - self.sizes.longer_m(their_length)

    def their_leaving_s(self, s: Tensor, direction: Tensor, their_length: Tensor | float) -> Tensor:
        """[...] m: `their_leaving` of oncoming vehicles of a length, for vehicles at s [...]."""
        return self._at(self.their_leaving, s, direction) + self.sizes.longer_m(their_length)

    def _at(self, table: Tensor, s: Tensor, direction: Tensor) -> Tensor:
        """[...] m: values of one of the fields for vehicles that drive in `direction` [...] and are at s [...]."""
        return self.road.of_place(table, self.leaving, s, direction)


def waiting_places(collisions: CollisionCheck, sizes: Sizes, latest_m: float, room_m: float) -> Tensor:
    """[2B, M] float32, m: s of the last places on the own route that the other can pass, by way and narrow place.

    They are places of the centre of a vehicle as long as the ego and as wide as the widest, which any other can pass.
    They lie `latest_m` at most behind the mouth of their narrow place. Where there is none within `FARTHEST_M`, it is
    -inf.

    room_m: on either side of the vehicle that passes
    """
    mouths = collisions.road.narrow_places[..., 0]
    before = torch.arange(latest_m, -FARTHEST_M, -STEP_M, device=mouths.device)
    s = mouths[..., None] + before  # [2B, M, K]
    return torch.where(_is_passable(collisions, sizes, s, room_m), s, -torch.inf).amax(-1)


def _leaving_places(collisions: CollisionCheck, sizes: Sizes) -> Tensor:
    """[2B, M] float32, m: s of the first places behind the narrow places that the other can pass, inf without one."""
    ends = collisions.road.narrow_places[..., 1]
    s = ends[..., None] + torch.arange(0.0, FARTHEST_M, STEP_M, device=ends.device)
    return torch.where(_is_passable(collisions, sizes, s, ROOM_M), s, torch.inf).amin(-1)


def _is_passable(collisions: CollisionCheck, sizes: Sizes, s: Tensor, room_m: float) -> Tensor:
    """[2B, M, K] bool: the other can pass a vehicle that stands on its route at s [2B, M, K]."""
    road, shape, s = collisions.road, s.shape, s.flatten()
    own = road.ways[:, None, None].expand(shape).flatten()
    zero = torch.zeros_like(s)
    standing = road.to_world(RouteState(s, zero, zero, *road.route_offset(s, own)), own)
    waiting = map_tensors(lambda field: field[:, None], standing)
    size = Size(sizes.ego.length, sizes.largest.width)
    is_closed = collisions.stands_on_route(waiting, size, -own[:, None], sizes.largest, room_m)
    return ~is_closed[:, 0].reshape(shape)
