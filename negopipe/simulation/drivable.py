"""Check of the routes of a road: room beside a vehicle on its route, and the sharpness of the route's bends."""

from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.simulation.geometry import Boxes, Size, boxes_from_pose, half_diagonal, overlap_depth
from negopipe.simulation.map_street import Footprint
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.streets import Streets

STEP_M = 1.0
"""Spacing of the places at which a route is checked, m."""

NEAR_M = 0.3
"""Distance to a kerb within which a footprint is checked exactly, m."""


class RouteCheck(NamedTuple):
    """Routes of B streets at K places each; fields [2B, K], by way.

    sigma: float32, m
    touches: bool, a vehicle that is grown by the clearance touches a kerb or a parked car
    curvature: float32, 1/m, of the route
    """

    sigma: Tensor
    touches: Tensor
    curvature: Tensor


class _Driven(NamedTuple):
    """Vehicles on the routes of B streets at K places each, fields [2B, K]; boxes: grown footprints, world frame."""

    s: Tensor
    way: Tensor
    boxes: Boxes
    curvature: Tensor


def check_routes(road: Streets, vehicle: Footprint, clearance_m: float) -> RouteCheck:
    """Both routes of every street, from end to end."""
    driven = _driven(road, vehicle, clearance_m)
    touches = is_in_a_car(driven.boxes, road.parked_boxes(driven.way)) | is_off_road_on_route(
        road, driven.boxes, driven.s, driven.way
    )
    return RouteCheck(road.sigma(driven.s, driven.way), touches, driven.curvature)


def is_drivable(road: Streets, vehicle: Footprint, clearance_m: float, curvature_max_1pm: float) -> Tensor:
    """[B] bool: on both routes a vehicle keeps clear of kerbs and parked cars, and no bend is too sharp.

    Kerbs take the most time, so they are checked only where nothing else is wrong with the street.
    """
    driven = _driven(road, vehicle, clearance_m)
    is_bad = is_in_a_car(driven.boxes, road.parked_boxes(driven.way)) | (driven.curvature.abs() > curvature_max_1pm)
    is_open = ~is_bad.unflatten(0, (-1, 2)).flatten(1).any(1)
    left = is_open.repeat_interleave(2)
    boxes = driven.boxes._replace(**{name: getattr(driven.boxes, name)[left] for name in ("x", "y", "cos", "sin")})
    is_off = is_off_road_on_route(road, boxes, driven.s[left], driven.way[left])
    is_open[is_open.clone()] = ~is_off.unflatten(0, (-1, 2)).flatten(1).any(1)
    return is_open


def _driven(road: Streets, vehicle: Footprint, clearance_m: float) -> _Driven:
    s = torch.arange(-road.reach_m, road.reach_m, STEP_M)
    way = road.ways[:, None].expand(-1, len(s))
    s = s + road.corridor_m(way) / 2
    zero = torch.zeros_like(s)
    on_route = road.to_world(RouteState(s, zero, zero, *road.route_offset(s, way)), way)
    x, y = on_route.position.unbind(-1)
    grown = 2 * clearance_m
    boxes = boxes_from_pose(x, y, on_route.yaw, vehicle.length_m + grown, vehicle.width_m + grown)
    return _Driven(s, way, boxes, on_route.curvature)


def is_in_a_car(boxes: Boxes, parked: Boxes, deeper_than_m: float = 0.0) -> Tensor:
    """[...] bool: footprints [...] of one size reach into a parked car, one of [..., N].

    Most cars are far away, so only those within reach are checked.
    """
    dx, dy = parked.x - boxes.x[..., None], parked.y - boxes.y[..., None]
    own, others = (half_diagonal(Size(2 * each.half_length, 2 * each.half_width)) for each in (boxes, parked))
    is_near = dx**2 + dy**2 < (own + others) ** 2
    vehicle = is_near.nonzero()[:, :-1].unbind(-1)
    near = boxes._replace(**{name: getattr(boxes, name)[vehicle] for name in ("x", "y", "cos", "sin")})
    cars = Boxes(*(torch.as_tensor(field).expand_as(is_near)[is_near] for field in parked))
    touches = torch.zeros_like(is_near)
    touches[is_near] = overlap_depth(near, cars) > deeper_than_m
    return touches.any(-1)


def is_off_road_on_route(road: Road, boxes: Boxes, s: Tensor, way: Tensor) -> Tensor:
    """[...] bool: vehicles on their routes at `s` [...] (m), with footprints `boxes` of one size, are over a kerb.

    Only those near a kerb are projected onto the line, which is what takes time.
    """
    is_near = _kerb_excess(road, boxes, s, way) > -NEAR_M
    near = boxes._replace(**{name: getattr(boxes, name)[is_near] for name in ("x", "y", "cos", "sin")})
    is_off = torch.zeros_like(is_near)
    is_off[is_near] = road.is_off_road(near, way[is_near])
    return is_off


def _kerb_excess(road: Road, boxes: Boxes, s: Tensor, way: Tensor) -> Tensor:
    """[...] m: about the depth over a kerb of vehicles on their routes; it takes no projection onto the line."""
    d, d_prime, _ = road.route_offset(s, way)
    kappa, _ = road.curvature(s, way)
    tan = d_prime / (1 - kappa * d)
    cos = torch.rsqrt(1 + tan**2)
    reach = boxes.half_length * tan.abs() * cos + boxes.half_width * cos
    return road.kerb_excess(s, way, d, reach, kappa.abs() * boxes.half_length**2 / 2)
