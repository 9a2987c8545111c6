"""Prediction of the other vehicles: constant velocity along the route that each of them drives."""

from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.schema import PositiveFloat, schema
from negopipe.simulation.road import Road
from negopipe.simulation.state import VehicleState


@schema
class PredictionConfig:
    """offset_decay_m: distance over which a predicted vehicle returns to its route, to 1/e of its offset."""

    offset_decay_m: PositiveFloat


class PredictedPath(NamedTuple):
    """Predicted poses in the viewer's SLT frame; every field [..., T] float32.

    s, d: m, route frame of the viewer's driving direction
    slope: d' of the path; the footprint's heading is atan(slope), up to half a turn
    """

    s: Tensor
    d: Tensor
    slope: Tensor


def predict(
    config: PredictionConfig, road: Road, other: VehicleState, viewer_direction: Tensor, times: Tensor
) -> PredictedPath:
    """Roll the perceived vehicles `other` [...] out to `times` [T] (s) and project them onto the viewer's frame.

    Speed along the road stays as perceived; the lateral offset from the route decays with the distance driven, so
    a vehicle that stands stays where it is. The driving direction is read off the perceived heading.

    viewer_direction: [...] float32, +1 or -1
    """
    direction = torch.where(torch.cos(other.yaw) < 0, -1.0, 1.0)
    now = road.to_route(other, direction)
    travelled = now.s_dot[..., None] * times
    s = now.s[..., None] + travelled
    route_d, route_slope, _ = road.route_offset(s, direction[..., None])
    route_d_now, route_slope_now, _ = road.route_offset(now.s, direction)
    fading = torch.exp(-travelled / config.offset_decay_m)
    offset = (now.d - route_d_now)[..., None] * fading
    slope = route_slope + (now.d_prime - route_slope_now)[..., None] * fading
    is_same = (direction == viewer_direction)[..., None]
    s_seen = torch.where(is_same, s, road.config.corridor_length_m - s)
    d_seen = torch.where(is_same, route_d + offset, -route_d - offset)
    return PredictedPath(s_seen, d_seen, slope)
