"""The road of a map: its street, cut where nobody could drive on, its routes checked; and where it lies on the map."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from negopipe.errors import UserError
from negopipe.maps import MapStreet
from negopipe.maps.street import to_plane
from negopipe.simulation.drivable import check_routes
from negopipe.simulation.map_config import MapConfig, read_map
from negopipe.simulation.map_street import MapRules, cut, narrow_places, street_of_map
from negopipe.simulation.scenario import ScenarioConfig
from negopipe.simulation.streets import Streets

N_CUTS = 20
"""Cuts of a street at most."""

MARGIN_M = 5.0
"""Length of the street beyond what the tasks need, and that is cut off beside a place where nobody can drive, m."""


@dataclass(frozen=True)
class MapFrame:
    """The world of a map's road, seen on the map.

    origin: [2] float64, x, y of the world's origin, m
    heading: of the world's x axis, rad
    """

    origin: np.ndarray
    heading: float

    def on_map(self, position: np.ndarray) -> np.ndarray:
        """[..., 2] float64: places of the world on the map, m."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return np.asarray(self.origin + position.astype(np.float64) @ np.array([[cos, sin], [-sin, cos]]))


def map_rules(scenario: ScenarioConfig) -> MapRules:
    """UserError where a size that a map needs is an interval."""
    road, streets = scenario.road, scenario.streets
    sizes = {name: getattr(road, name) for name in ("swerve_length_m", "lane_offset_m", "target_distance_m")}
    for name, size in sizes.items():
        if isinstance(size, tuple):
            raise UserError(f"scenario.road.{name} must be a number where scenario.map is set, got {list(size)}")
    target_m = sizes["target_distance_m"]
    social_m = max(family.start_distance_m[1] for family in scenario.families.values())
    behind_ego_m, behind_social_m = scenario.queue_m
    return MapRules(
        vehicle=scenario.vehicle,
        swerve_m=sizes["swerve_length_m"],
        lane_m=sizes["lane_offset_m"],
        target_m=target_m,
        before_m=max(scenario.ego_start_distance_m[1] + behind_ego_m, target_m) + MARGIN_M,
        behind_m=max(social_m + behind_social_m, target_m) + MARGIN_M,
        clearance_m=streets.clearance_m,
        curvature_max_1pm=streets.curvature_max_1pm,
    )


@lru_cache(maxsize=4)  # a config's check and its game need the same road
def build_map_road(config: MapConfig, rules: MapRules, device: torch.device) -> Streets:
    """The street of a map. Where nobody could drive on, farther away than the tasks need, it is cut.

    UserError: no such map or street, or a route without room or with too sharp a bend.
    """
    return Streets([street_of_map(_driven_part(config, rules), rules, Path(config.file))], device)


def map_frame(config: MapConfig, rules: MapRules) -> MapFrame:
    """Where the world of `build_map_road` lies on the map: its origin is in the middle of all narrow places."""
    street = _driven_part(config, rules)
    narrow = narrow_places(street, rules, Path(config.file))
    (origin,), (heading,) = to_plane(street, np.array([(narrow[0, 0] + narrow[-1, 1]) / 2]), np.zeros(1))
    return MapFrame(origin, float(heading))


@lru_cache(maxsize=4)
def _driven_part(config: MapConfig, rules: MapRules) -> MapStreet:
    return drivable_part(read_map(config), rules, Path(config.file))


def drivable_part(street: MapStreet, rules: MapRules, path: Path) -> MapStreet:
    """The map's street without its ends beyond places where nobody could drive."""
    begin_m = 0.0  # of the part, on the map
    for _ in range(N_CUTS):
        narrow = narrow_places(street, rules, path)
        middle = float(narrow[0, 0] + narrow[-1, 1]) / 2
        road = Streets([street_of_map(street, rules, path)])
        bad = _undrivable(road, rules)
        bad = {along: why for sigma, why in bad.items() if 0 <= (along := sigma + middle) <= street.length_m}
        before_m, behind_m = narrow[0, 0] - rules.before_m, narrow[-1, 1] + rules.behind_m
        for along, why in bad.items():
            if before_m <= along <= behind_m:
                raise UserError(f"{path}: {begin_m + along:.1f} m along the street {why}")
        if not bad:
            return street
        first_m = max([0.0, *(along + MARGIN_M for along in bad if along < before_m)])
        last_m = min([street.length_m, *(along - MARGIN_M for along in bad if along > behind_m)])
        street = cut(street, min(first_m, before_m), max(last_m, behind_m))
        begin_m += min(first_m, before_m)
    raise UserError(f"{path}: its street cannot be driven on; {N_CUTS} cuts left {street.length_m:.1f} m of it")


def _undrivable(road: Streets, rules: MapRules) -> dict[float, str]:
    """sigma of the places at which a route breaks the rules, and what is wrong there."""
    routes = check_routes(road, rules.vehicle, rules.clearance_m)
    is_sharp = routes.curvature.abs() > rules.curvature_max_1pm
    bad = {}
    for sigma, touches, sharp, kappa in zip(
        *(field.flatten().tolist() for field in (routes.sigma, routes.touches, is_sharp, routes.curvature)), strict=True
    ):
        if touches:
            bad[sigma] = f"a route has less than scenario.streets.clearance_m = {rules.clearance_m:g} beside a vehicle"
        elif sharp:
            allowed = f"scenario.streets.curvature_max_1pm = {rules.curvature_max_1pm:g} is allowed"
            bad[sigma] = f"a route bends with {abs(kappa):.3f} 1/m; {allowed} (a longer scenario.road.swerve_length_m)"
    return bad
