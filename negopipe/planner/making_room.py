"""Making room: who stands behind a vehicle that has to drive back drives back first.

Two vehicles nose to nose cannot part as long as each has one close behind it. The one behind sees why: the vehicle
ahead of it stands in the passage, or drives back in it, with an oncoming one close before it. It needs no long
prediction horizon, since it gives way to nobody but the vehicle ahead.
"""

import torch
from torch import Tensor

from negopipe.planner.situation import Others, Situation
from negopipe.simulation.waiting_place import Passage

NOSE_M = 6.0
"""Largest distance between the bumpers of two vehicles that are nose to nose, m."""
AT_REST_MPS = 0.1
"""Speed up to which another vehicle is seen at rest, m/s."""
ROUNDING_M = 0.02
"""Distance by which a place may be missed, m."""


def way_for_those_ahead(passage: Passage, now: Situation, beyond_m: float, room_m: float) -> Tensor:
    """[N] m: distance to drive back for the vehicles ahead; 0 or less with room for them, -inf where none asks.

    beyond_m: distance behind the last place where the other can pass at which a way back ends
    room_m: between two vehicles there
    """
    others = now.others
    length = torch.zeros_like(others.s) + others.size.length
    is_ahead = others.is_seen & others.is_same & (others.s > now.route.s)
    end = passage.waiting_s(others.s, now.direction, others.size.length) - beyond_m
    is_in_passage = end.isfinite() & (others.s > end + ROUNDING_M)
    is_asking = is_ahead & is_in_passage & (others.route.s_dot < AT_REST_MPS) & _is_met(others, length)
    is_between = is_ahead & (others.s < others.s[:, None])  # [O asking, O between, N]
    taken = torch.where(is_between, length + room_m, 0.0).sum(1)
    latest = end - (length + now.size.length) / 2 - room_m - taken
    return torch.where(is_asking, now.route.s - latest, -torch.inf).amax(0)


def _is_met(others: Others, length: Tensor) -> Tensor:
    """[O, N] bool: an oncoming vehicle is nose to nose with each of the others."""
    gap = others.s - others.s[:, None] - (length + length[:, None]) / 2  # [O, O oncoming, N]
    return (others.is_oncoming & (gap > -ROUNDING_M) & (gap < NOSE_M)).any(1)
