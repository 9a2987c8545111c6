"""The kinematic car: no slip, for walking pace, standstill and driving backwards."""

import math

from negopipe.deployment.vehicle.body import Body, Geometry


def rolled(body: Body, steer_rate: float, accel: float, gear: float, geometry: Geometry, step_s: float) -> Body:
    """The body one step later.

    A car that comes to rest stays there until it is accelerated in the direction of its gear: brakes do not push back.

    steer_rate: rad/s; accel: m/s2 along the car's axis; gear: +1 forwards, -1 backwards
    """
    most = geometry.steer_max_rad
    steer = max(-most, min(most, body.steer + steer_rate * step_s))
    speed = body.speed + accel * step_s
    if body.speed * speed < 0 or (body.speed == 0 and accel * gear <= 0):
        speed = 0.0
    driven = (body.speed + speed) / 2 * step_s
    turned = driven * math.tan(steer) / geometry.wheelbase_m
    middle = body.yaw + turned / 2
    return Body(
        body.x + driven * math.cos(middle),
        body.y + driven * math.sin(middle),
        body.yaw + turned,
        speed,
        0.0,
        speed * math.tan(steer) / geometry.wheelbase_m,
        steer,
    )
