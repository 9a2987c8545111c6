"""Random situations for tests of the planner: any place, offset, heading and speed, whoever else is there."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from negopipe.planner.situation import Others, Situation
from negopipe.simulation.geometry import Boxes, Size, boxes_from_pose
from negopipe.simulation.one_street import OneStreet
from negopipe.simulation.road import RouteState
from negopipe.simulation.state import VehicleState

CAR = Size(4.5, 1.8)


def draw_situations(road: OneStreet, n: int, seed: int) -> Situation:
    """N vehicles, each beside one other. Half of the others drive the same way; all are within reach of a plan."""
    generator = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(n, generator=generator)

    def sign() -> Tensor:
        return between(-1, 1).sign()

    direction = sign()
    route = _somewhere(road, between(-25, 18), direction, between)
    own_sigma = direction * (route.s - road.config.corridor_length_m / 2)
    other_direction = sign()
    other_sigma = own_sigma + direction * between(-12, 35)
    other_s = other_direction * other_sigma + road.config.corridor_length_m / 2
    other = road.to_world(_somewhere(road, other_s, other_direction, between), other_direction)
    columns = (field[None] for field in (other.position, other.yaw, other.speed, other.accel, other.curvature))
    others = Others.of(road, VehicleState(*columns), direction, torch.ones(1, n, dtype=torch.bool), CAR)
    return Situation(route, direction, between(3, 6), between(0, 6), CAR, others)


def _somewhere(road: OneStreet, s: Tensor, direction: Tensor, between: Callable[[float, float], Tensor]) -> RouteState:
    """Beside the route by up to 1 m, turned from it by up to 25 degrees, at any speed and acceleration."""
    d, d_prime, _ = road.route_offset(s, direction)
    turned = math.tan(math.radians(25))
    return RouteState(
        s, between(0, 6), between(-3, 2), d + between(-1, 1), d_prime + between(-turned, turned), between(-0.1, 0.1)
    )


def world_boxes(
    road: OneStreet, s: Tensor, direction: Tensor, d: Tensor, tan: Tensor, length: float, width: float
) -> Boxes:
    """True footprints of vehicles whose heading has the tangent `tan` to the line; all broadcast, float64."""
    s, direction, d, tan = torch.broadcast_tensors(*(field.double() for field in (s, direction, d, tan)))
    sigma = direction * (s - road.config.corridor_length_m / 2)
    yaw = torch.atan(tan) + road.reference.heading(sigma) + (1 - direction) * (math.pi / 2)
    return boxes_from_pose(*road.reference.place(sigma, direction * d), yaw, length, width)
