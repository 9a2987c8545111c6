"""Prediction of the other vehicles, each along its own route."""

from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from negopipe.planner.situation import Others
from negopipe.schema import PositiveFloat, PositiveMetres, schema
from negopipe.simulation.road import Road, RouteState


@schema
class ConstantVelocityConfig:
    """Prediction with the perceived speed along the road.

    offset_decay_m: distance over which a predicted vehicle returns to its route, to 1/e of its offset
    """

    kind: Literal["constant_velocity"]
    offset_decay_m: PositiveMetres

    def travelled(self, now: RouteState, times: Tensor) -> Tensor:
        """Metres along the road [..., T, N] after `times` [T] (s); `now` fields [..., N]."""
        return now.s_dot[..., None, :] * times[:, None]


@schema
class ConstantAccelerationConfig:
    """Prediction with the perceived acceleration for a while, between standstill and a highest speed.

    offset_decay_m: as for constant velocity
    hold_s: time for which the acceleration is held; the speed reached then is kept
    speed_max_mps: highest speed to which a vehicle is predicted to accelerate
    """

    kind: Literal["constant_acceleration"]
    offset_decay_m: PositiveMetres
    hold_s: PositiveFloat
    speed_max_mps: PositiveFloat

    def travelled(self, now: RouteState, times: Tensor) -> Tensor:
        """Metres along the road [..., T, N] after `times` [T] (s); `now` fields [..., N]."""
        speed, accel = now.s_dot, now.s_ddot
        room = torch.where(accel < 0, speed, self.speed_max_mps - speed).clamp(min=0)  # m/s until the bound
        accelerating_s = (room / accel.abs().clamp(min=1e-3)).clamp(max=self.hold_s)[..., None, :]
        t = times[:, None]
        accelerated = torch.minimum(t, accelerating_s)
        return speed[..., None, :] * t + accel[..., None, :] * accelerated * (t - accelerated / 2)


PredictionConfig = Annotated[ConstantVelocityConfig | ConstantAccelerationConfig, Field(discriminator="kind")]


class PredictedPath(NamedTuple):
    """Predicted poses in the viewer's route frame; every field [O, T, N] float32.

    s, d: m
    tan_heading: 1, tangent of the footprint's heading relative to the line; the heading itself up to half a turn
    """

    s: Tensor
    d: Tensor
    tan_heading: Tensor


def predict(
    config: PredictionConfig, road: Road, others: Others, viewer_direction: Tensor, times: Tensor
) -> PredictedPath:
    """Predicted poses of `others` [O, N] at `times` [T] (s), in the frames of their viewers [N]."""
    return along_routes(road, others, viewer_direction, config.travelled(others.route, times), config.offset_decay_m)


def along_routes(
    road: Road, others: Others, viewer_direction: Tensor, travelled: Tensor, offset_decay_m: float
) -> PredictedPath:
    """Poses of `others` [O, N] after distances `travelled` [O, T, N] (m), in the frames of their viewers.

    The lateral offset from the route decays with the distance driven, so a standing vehicle stays in its place. The
    driving direction is that of the perceived heading.

    viewer_direction: [N]
    offset_decay_m: distance over which the offset decays to 1/e
    """
    now, direction = others.route, others.direction
    s = now.s[..., None, :] + travelled
    route_d, route_d_prime, _ = road.route_offset(s, direction[..., None, :])
    route_d_now, route_d_prime_now, _ = road.route_offset(now.s, direction)
    fading = torch.exp(-travelled.abs() / offset_decay_m)
    offset = (now.d - route_d_now)[..., None, :] * fading
    tan_heading = route_d_prime + (now.d_prime - route_d_prime_now)[..., None, :] * fading
    if not road.is_straight:
        kappa, _ = road.curvature(s, direction[..., None, :])
        tan_heading = tan_heading / (1 - kappa * (route_d + offset))
    is_same = others.is_same[..., None, :]
    s_seen = torch.where(is_same, s, road.corridor_m(viewer_direction) - s)
    d_seen = torch.where(is_same, route_d + offset, -route_d - offset)
    return PredictedPath(s_seen, d_seen, tan_heading)
