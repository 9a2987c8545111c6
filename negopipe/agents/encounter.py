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
    own_m: [E, S, 1], length of the agent, m
    other_m: [E, S, O], lengths of the others, m
    other_s, other_speed: [E, S, O], m and m/s
    apart_m: [E, S, O], distance along the road; negative once they have passed each other
    touch_m: [E, S, O], distance at which their bumpers touch
    is_oncoming: [E, S, O] bool, seen, driving the other way and not yet past in full length
    is_ahead: [E, S, O] bool, seen, driving the same way and farther along
    """

    own: RouteState
    own_s: Tensor
    narrow_m: Tensor
    own_m: Tensor
    other_m: Tensor
    other_s: Tensor
    other_speed: Tensor
    apart_m: Tensor
    touch_m: Tensor
    is_oncoming: Tensor
    is_ahead: Tensor


def encounter(road: Road, perception: Perception) -> Encounter:
    """Encounter as each agent perceives it."""
    own = road.to_route(perception.own, perception.direction)
    viewed = perception.direction[..., None]
    other_direction, other = road.to_own_route(perception.other, viewed)
    apart = road.corridor_m(viewed) - other.s - own.s[..., None]
    is_opposite = other_direction != viewed
    own_m, other_m = perception.length[..., None], perception.other_length
    touch_m = (own_m + other_m) / 2
    is_oncoming = perception.is_seen & is_opposite & (apart > -touch_m)
    is_ahead = perception.is_seen & ~is_opposite & (other.s > own.s[..., None])
    first, last = road.narrow_place(own.s, perception.direction)
    mouth = torch.where(is_opposite, road.corridor_m(viewed) - last[..., None], first[..., None])
    return Encounter(
        own=own,
        own_s=own.s - first,
        narrow_m=last - first,
        own_m=own_m,
        other_m=other_m,
        other_s=other.s - mouth,
        other_speed=other.s_dot,
        apart_m=apart,
        touch_m=touch_m,
        is_oncoming=is_oncoming,
        is_ahead=is_ahead,
    )
