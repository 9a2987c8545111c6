"""Prediction of the other vehicles along the route that each of them drives."""

from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from negopipe.schema import PositiveFloat, PositiveMetres, schema
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.state import VehicleState
from negopipe.tensors.materialize import materialize


@schema
class ConstantVelocityConfig:
    """Speed along the road stays as perceived.

    offset_decay_m: distance over which a predicted vehicle returns to its route, to 1/e of its offset
    """

    kind: Literal["constant_velocity"]
    offset_decay_m: PositiveMetres

    def travelled(self, now: RouteState, times: Tensor) -> Tensor:
        """Metres along the road [..., T, N] after `times` [T] (s); `now` fields [..., N]."""
        return now.s_dot[..., None, :] * times[:, None]


@schema
class ConstantAccelerationConfig:
    """The perceived acceleration goes on for a while, between standstill and a highest speed.

    offset_decay_m: as for constant velocity
    hold_s: how long the acceleration is held; the speed reached then is kept
    speed_max_mps: nobody is predicted to speed up beyond this, unless it is faster already
    """

    kind: Literal["constant_acceleration"]
    offset_decay_m: PositiveMetres
    hold_s: PositiveFloat
    speed_max_mps: PositiveFloat

    def travelled(self, now: RouteState, times: Tensor) -> Tensor:
        """Metres along the road [..., T, N] after `times` [T] (s); `now` fields [..., N]."""
        speed, accel = now.s_dot, now.s_ddot
        room = torch.where(accel < 0, speed, (self.speed_max_mps - speed).clamp(min=0))  # m/s until the bound
        lasting = (room / accel.abs().clamp(min=1e-3)).clamp(max=self.hold_s)[..., None, :]
        t = times[:, None]
        accelerating = torch.minimum(t, lasting)
        return speed[..., None, :] * t + accel[..., None, :] * accelerating * (t - accelerating / 2)


PredictionConfig = Annotated[ConstantVelocityConfig | ConstantAccelerationConfig, Field(discriminator="kind")]


class PredictedPath(NamedTuple):
    """Predicted poses in the viewer's route frame; every field [..., T, N] float32.

    s, d: m
    slope: tangent of the footprint's heading relative to the line, up to half a turn
    """

    s: Tensor
    d: Tensor
    slope: Tensor


def predict(
    config: PredictionConfig, road: Road, other: VehicleState, viewer_direction: Tensor, times: Tensor
) -> PredictedPath:
    """Roll the perceived vehicles `other` [..., N] out to `times` [T] (s), as their viewers see it.

    The lateral offset from the route decays with the distance driven, so a vehicle that stands stays where it is.
    The driving direction is read off the perceived heading.

    viewer_direction: [N] float32, +1 or -1
    """
    direction = road.direction_of(other)
    *state, direction = materialize(*road.to_route(other, direction), direction)
    now = RouteState(*state)
    travelled = config.travelled(now, times)
    s = now.s[..., None, :] + travelled
    route_d, route_slope, _ = road.route_offset(s, direction[..., None, :])
    route_d_now, route_slope_now, _ = road.route_offset(now.s, direction)
    fading = torch.exp(-travelled / config.offset_decay_m)
    offset = (now.d - route_d_now)[..., None, :] * fading
    slope = route_slope + (now.d_prime - route_slope_now)[..., None, :] * fading
    if not road.reference.is_straight:
        kappa, _ = road.curvature(s, direction[..., None, :])
        slope = slope / (1 - kappa * (route_d + offset))
    is_same = (direction == viewer_direction)[..., None, :]
    s_seen = torch.where(is_same, s, road.config.corridor_length_m - s)
    d_seen = torch.where(is_same, route_d + offset, -route_d - offset)
    return PredictedPath(s_seen, d_seen, slope)
