"""The road of a scenario: one street in closed form, or many by table, drawn so that a vehicle can drive on them."""

from functools import lru_cache

import torch
from torch import Tensor

from negopipe.errors import UserError
from negopipe.simulation.geometry import boxes_from_pose, overlap_depth
from negopipe.simulation.one_street import BEYOND_M, OneStreet
from negopipe.simulation.road import Road, RouteState
from negopipe.simulation.road_config import RoadConfig, StreetConfig, StreetsConfig
from negopipe.simulation.scenario import ScenarioConfig, VehicleConfig
from negopipe.simulation.street import Street
from negopipe.simulation.streets import Streets
from negopipe.tensors.seeding import generator

STEP_M = 1.0
"""Spacing of the places at which a drawn street is checked, m."""

N_DRAWN = 128
"""Streets that are drawn and checked together."""

LEAST_SHARE = 1 / 50
"""Share of the drawn streets that must be drivable."""


def build_road(scenario: ScenarioConfig, device: torch.device | str = "cpu") -> Road:
    """The streets of a scenario by their numbers, see `ScenarioConfig.held_out_streets`."""
    return _built(scenario.road, scenario.streets, scenario.vehicle, torch.device(device))


def draw_streets(scenario: ScenarioConfig) -> tuple[StreetConfig, ...]:
    """The streets of a scenario by their numbers, from 1 on: those of the training, then those that are held out."""
    return _drawn(scenario.road, scenario.streets, scenario.vehicle)


@lru_cache(maxsize=4)  # a config's check and its game need the same road
def _built(road: RoadConfig, streets: StreetsConfig, vehicle: VehicleConfig, device: torch.device) -> Road:
    configs = _drawn(road, streets, vehicle)
    if len(configs) == 1 and configs[0].is_closed_form:
        return OneStreet(configs[0], device)
    return _by_table(configs, device)


@lru_cache(maxsize=4)
def _drawn(road: RoadConfig, streets: StreetsConfig, vehicle: VehicleConfig) -> tuple[StreetConfig, ...]:
    if not road.varies:
        return (road.street,)
    parts = ((streets.n_training, "training streets"), (streets.n_held_out, "held-out streets"))
    return tuple(
        street
        for n, name in parts
        for street in _drivable_streets(road, streets, vehicle, n, generator(streets.seed, name))
    )


def _by_table(configs: tuple[StreetConfig, ...], device: torch.device | str) -> Streets:
    reach_m = BEYOND_M + max(config.reach_m for config in configs)
    return Streets([Street.of(config, reach_m) for config in configs], device)


def _drivable_streets(
    road: RoadConfig, streets: StreetsConfig, vehicle: VehicleConfig, n: int, random: torch.Generator
) -> list[StreetConfig]:
    """`n` streets whose routes keep to the requirements of `streets`; UserError where too few do."""
    found: list[StreetConfig] = []
    n_drawn = 0
    while len(found) >= n_drawn * LEAST_SHARE:
        drawn = tuple(road.draw(N_DRAWN, random))
        n_drawn += len(drawn)
        is_drivable = _is_drivable(_by_table(drawn, "cpu"), streets, vehicle).tolist()
        found += [street for street, is_good in zip(drawn, is_drivable, strict=True) if is_good]
        if len(found) >= n:
            return found[:n]
    rule = f"streets.clearance_m = {streets.clearance_m} and curvature_max_1pm = {streets.curvature_max_1pm}"
    raise UserError(f"scenario.road must leave streets with {rule}, {len(found)} of {n_drawn} do: {road.intervals}")


def _is_drivable(road: Streets, streets: StreetsConfig, vehicle: VehicleConfig) -> Tensor:
    """[B] bool: on both routes a vehicle keeps clear of kerbs and parked cars, and no bend is too sharp."""
    s = torch.arange(-road.reach_m, road.reach_m, STEP_M)
    way = road.ways[:, None].expand(-1, len(s))
    s = s + road.corridor_m(way) / 2
    zero = torch.zeros_like(s)
    on_route = road.to_world(RouteState(s, zero, zero, *road.route_offset(s, way)), way)
    grown = 2 * streets.clearance_m
    x, y = on_route.position.unbind(-1)
    boxes = boxes_from_pose(x, y, on_route.yaw, vehicle.length_m + grown, vehicle.width_m + grown)
    x, y, cos, sin = (field[..., None] for field in boxes[:4])
    each = boxes._replace(x=x, y=y, cos=cos, sin=sin)
    touches = (overlap_depth(each, road.parked_boxes(way)) > 0).any(-1) | road.is_off_road(boxes, way)
    is_bad = touches | (on_route.curvature.abs() > streets.curvature_max_1pm)
    return ~is_bad.unflatten(0, (-1, 2)).flatten(1).any(1)
