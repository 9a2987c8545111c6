"""Following: who drives behind keeps the distance, whatever its prediction horizon.

A driver that predicts nothing would run into the vehicle ahead in its own lane as soon as that one slows down. A leader
would have no plan as soon as its follower is closer than a plan may come. On a road, both are the follower's matter.
"""

import torch
from torch import Tensor

from negopipe.planner.situation import Situation


def predicted_s(leader_horizon_s: float, now: Situation) -> Tensor:
    """[O, N] s: time over which each other vehicle is predicted.

    A leader, ahead in the same direction, is predicted over `leader_horizon_s` at least, a follower not at all, an
    oncoming vehicle over the prediction horizon.
    """
    of_same = torch.where(now.others.s > now.route.s, now.horizon.clamp(min=leader_horizon_s), 0.0)
    return torch.where(now.others.is_same, of_same, now.horizon)
