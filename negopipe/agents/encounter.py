"""How the ego and those who come towards it stand along the road: what rules of the road speak of."""

from typing import NamedTuple

from torch import Tensor

from negopipe.simulation.perception import Perception
from negopipe.simulation.road import Road, RouteState


class Encounter(NamedTuple):
    """Of one agent with the O others; places are those of the centres, each on its own route, where s = 0 is the mouth
    of the corridor that it meets first.

    own: RouteState [E, 1]
    other_s, other_speed: [E, 1, O], m, m/s
    apart_m: [E, 1, O], along the road; negative once they have passed each other
    is_oncoming: [E, 1, O] bool, seen, driving the other way and not yet past by a vehicle's length
    """

    own: RouteState
    other_s: Tensor
    other_speed: Tensor
    apart_m: Tensor
    is_oncoming: Tensor


def encounter(road: Road, length_m: float, perception: Perception) -> Encounter:
    """What a agent (S = 1) perceives, along the road; length_m: of a vehicle."""
    own = road.to_route(perception.own, perception.direction)
    other_direction = road.direction_of(perception.other)
    other = road.to_route(perception.other, other_direction)
    apart = road.config.corridor_length_m - other.s - own.s[..., None]
    is_opposite = other_direction != perception.direction[..., None]
    is_oncoming = perception.is_seen & is_opposite & (apart > -length_m)
    return Encounter(own, other.s, other.s_dot, apart, is_oncoming)
