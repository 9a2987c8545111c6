"""The situation of the vehicles that plan: their own motion and the others, along the road."""

from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.simulation.geometry import Size
from negopipe.simulation.perception import Perception
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.sizes import Sizes
from negopipe.simulation.state import VehicleState
from negopipe.tensors.materialize import materialize
from negopipe.tensors.tree import map_tensors


class Others(NamedTuple):
    """O others of each of N vehicles that plan; every field [O, N].

    route: RouteState, motion along their own routes
    direction: +n or -n, by the perceived heading
    is_same: bool, they drive in the direction of the vehicle that plans
    s, d: m, place in the route frame of the vehicle that plans
    speed: m/s
    is_seen: bool
    size: Size, of the footprints, or floats where all are alike
    """

    route: RouteState
    direction: Tensor
    is_same: Tensor
    s: Tensor
    d: Tensor
    speed: Tensor
    is_seen: Tensor
    size: Size

    @staticmethod
    def of(road: Road, vehicles: VehicleState, viewer_direction: Tensor, is_seen: Tensor, size: Size) -> "Others":
        """Others from their states [O, N]; viewer_direction: [N], of the vehicles that plan."""
        direction, route = road.to_own_route(vehicles, viewer_direction)
        *state, direction, speed = materialize(*route, direction, vehicles.speed)
        route, is_same = RouteState(*state), direction == viewer_direction
        s = torch.where(is_same, route.s, road.corridor_m(viewer_direction) - route.s)
        return Others(route, direction, is_same, s, torch.where(is_same, route.d, -route.d), speed, is_seen, size)

    @property
    def size_at_times(self) -> Size:
        """Sizes with an axis for times, [O, 1, N]."""
        return Size(*(field[:, None] if isinstance(field, Tensor) else field for field in self.size))

    @property
    def is_oncoming(self) -> Tensor:
        """[O, N] bool: seen, in the opposite direction."""
        return self.is_seen & ~self.is_same


class Situation(NamedTuple):
    """N vehicles that plan, each among O others; fields [N].

    route: RouteState, motion along the route
    direction: +n or -n
    desired_speed: m/s; horizon: s, prediction horizon
    size: Size, of the footprint, or floats where all are alike
    others: Others [O, N]
    """

    route: RouteState
    direction: Tensor
    desired_speed: Tensor
    horizon: Tensor
    size: Size
    others: Others

    @staticmethod
    def of(road: Road, sizes: Sizes, perception: Perception, horizon: Tensor) -> "Situation":
        """Situation of all agents, with their prediction horizons [E, S] (s), N = E S."""
        own = map_tensors(_flatten, perception.own)
        other = map_tensors(lambda field: _flatten(field).transpose(0, 1), perception.other)
        direction, desired_speed = perception.direction.flatten(), perception.desired_speed.flatten()
        own_size = perception.length.flatten(), perception.width.flatten()
        *fields, direction, desired_speed, length, width = materialize(
            *road.to_route(own, direction), direction, desired_speed, *own_size
        )
        is_seen, *other_size = (
            _flatten(field).transpose(0, 1)
            for field in (perception.is_seen, perception.other_length, perception.other_width)
        )
        others = Others.of(road, other, direction, is_seen, sizes.of(*materialize(*other_size)))
        route, size = RouteState(*fields), sizes.of(length, width)
        return Situation(route, direction, desired_speed, horizon.flatten(), size, others)


def _flatten(field: Tensor) -> Tensor:
    return field.flatten(0, 1)
