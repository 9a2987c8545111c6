"""The encounter of the ego with oncoming vehicles along the road, in which rules of the road are stated."""

from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.simulation.perception import Perception
from negopipe.simulation.road import Road, RouteState


class Encounter(NamedTuple):
    """Encounter of S agents with O others each.

    Places are those of the vehicles' centres, each on its own route, from the mouth that the vehicle meets first of the
    agent's narrow place: the one in which the agent is, or to which it comes next.

    own: RouteState [E, S], in the frame of the whole street
    own_s, narrow_m: [E, S], m; place of the agent, length of the narrow place
    other_s, other_speed: [E, S, O], m and m/s
    apart_m: [E, S, O], distance along the road; negative once they have passed each other
    is_oncoming: [E, S, O] bool, seen, driving the other way and not yet past by a vehicle's length
    is_ahead: [E, S, O] bool, seen, driving the same way and farther along
    """

    own: RouteState
    own_s: Tensor
    narrow_m: Tensor
    other_s: Tensor
    other_speed: Tensor
    apart_m: Tensor
    is_oncoming: Tensor
    is_ahead: Tensor


def encounter(road: Road, length_m: float, perception: Perception) -> Encounter:
    """Encounter as each agent perceives it.

    length_m: length of a vehicle
    """
    own = road.to_route(perception.own, perception.direction)
    viewed = perception.direction[..., None]
    other_direction, other = road.to_own_route(perception.other, viewed)
    apart = road.corridor_m(viewed) - other.s - own.s[..., None]
    is_opposite = other_direction != viewed
    is_oncoming = perception.is_seen & is_opposite & (apart > -length_m)
    is_ahead = perception.is_seen & ~is_opposite & (other.s > own.s[..., None])
    first, last = road.narrow_place(own.s, perception.direction)
    mouth = torch.where(is_opposite, road.corridor_m(viewed) - last[..., None], first[..., None])
    return Encounter(own, own.s - first, last - first, other.s - mouth, other.s_dot, apart, is_oncoming, is_ahead)
