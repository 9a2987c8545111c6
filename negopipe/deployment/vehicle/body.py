"""The state of a car's body and its geometry; plain Python."""

import math
from typing import NamedTuple

from negopipe.deployment.history import wrapped


class Geometry(NamedTuple):
    """Geometry of a car with front steering.

    wheelbase_m: distance between the axles
    steer_max_rad: largest angle of the front wheels
    steer_rate_max_radps: largest rate of that angle
    """

    wheelbase_m: float
    steer_max_rad: float
    steer_rate_max_radps: float


class Body(NamedTuple):
    """Motion of a car.

    x, y: m, middle of the rear axle in the world; yaw: rad
    speed: m/s, along the car's axis, negative backwards; lateral: m/s, of the rear axle to the left, its slip
    yaw_rate: rad/s; steer: rad, angle of the front wheels, positive to the left
    """

    x: float
    y: float
    yaw: float
    speed: float
    lateral: float
    yaw_rate: float
    steer: float


class CarState(NamedTuple):
    """A car as the runtime and the simulator see it: the middle of its footprint.

    That is taken to be halfway between the axles, since the parameters of the cars tell no overhangs.

    x, y: m; yaw: rad, of the body; speed: m/s, negative backwards; accel: m/s2, that of drive train and brakes
    curvature: 1/m, of the path that the steering angle leads to
    """

    x: float
    y: float
    yaw: float
    speed: float
    accel: float
    curvature: float


def middle_curvature(steer: float, wheelbase_m: float) -> float:
    """Curvature of the path of the point halfway between the axles, 1/m, without slip."""
    return 2 / wheelbase_m * math.sin(math.atan(math.tan(steer) / 2))


def steer_of(curvature: float, wheelbase_m: float) -> float:
    """The inverse of `middle_curvature`, rad; the sharpest possible bend for sharper ones."""
    return math.atan(2 * math.tan(slip_of(curvature, wheelbase_m)))


def slip_of(curvature: float, wheelbase_m: float) -> float:
    """Angle from the car's axis to the course of the point halfway between the axles, rad."""
    return math.asin(max(-0.9, min(0.9, curvature * wheelbase_m / 2)))


def car_state(body: Body, accel: float, geometry: Geometry) -> CarState:
    """The state of the middle of the footprint; accel: m/s2."""
    half_m = geometry.wheelbase_m / 2
    sideways = body.lateral + body.yaw_rate * half_m
    return CarState(
        body.x + half_m * math.cos(body.yaw),
        body.y + half_m * math.sin(body.yaw),
        wrapped(body.yaw),
        math.copysign(math.hypot(body.speed, sideways), body.speed),
        accel,
        middle_curvature(body.steer, geometry.wheelbase_m),
    )


def body_at(state: CarState, geometry: Geometry) -> Body:
    """The body of a car that rolls without slip in a state."""
    half_m, steer = geometry.wheelbase_m / 2, steer_of(state.curvature, geometry.wheelbase_m)
    speed = state.speed * math.cos(slip_of(state.curvature, geometry.wheelbase_m))
    return Body(
        state.x - half_m * math.cos(state.yaw),
        state.y - half_m * math.sin(state.yaw),
        state.yaw,
        speed,
        0.0,
        speed * math.tan(steer) / geometry.wheelbase_m,
        steer,
    )
