"""Following: who drives behind keeps the distance, whatever its prediction horizon.

A driver that predicts nothing would run into the vehicle ahead in its own lane as soon as that one slows down. A leader
would have no plan as soon as its follower is closer than a plan may come. On a road, both are the follower's matter.
"""

import torch
from torch import Tensor

from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.state import VehicleState


def predicted_s(
    leader_horizon_s: float, road: Road, route: RouteState, direction: Tensor, horizon: Tensor, other: VehicleState
) -> Tensor:
    """[O, N] s: time over which each other vehicle is predicted.

    A leader, ahead in the same direction, is predicted over `leader_horizon_s` at least, a follower not at all, an
    oncoming vehicle over the prediction horizon.

    route: of the vehicles that plan, fields [N]; direction, horizon: [N], +1 or -1 and s; other: fields [O, N]
    """
    is_same = road.direction_of(other, direction) == direction
    is_leader = road.to_route(other, direction).s > route.s
    of_same = torch.where(is_leader, horizon.clamp(min=leader_horizon_s), 0.0)
    return torch.where(is_same, of_same, horizon)
