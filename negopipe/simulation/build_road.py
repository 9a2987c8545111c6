"""The road of a scenario: one street in closed form, or by table that of a map or many that a vehicle can drive on."""

from collections.abc import Sequence
from functools import lru_cache

import torch

from negopipe.errors import UserError
from negopipe.simulation.drawn_street import drawn_street
from negopipe.simulation.drivable import is_drivable
from negopipe.simulation.knot_tables import BEYOND_M
from negopipe.simulation.map_road import build_map_road, map_rules
from negopipe.simulation.one_street import OneStreet
from negopipe.simulation.road import Road
from negopipe.simulation.road_config import RoadConfig, StreetConfig, StreetsConfig
from negopipe.simulation.scenario import ScenarioConfig, VehicleConfig
from negopipe.simulation.streets import Streets
from negopipe.tensors.seeding import generator

N_DRAWN = 128
"""Streets that are drawn together, and checked together unless far fewer are wanted."""

N_CHECKED_PER_STREET = 8
"""Streets that are checked together for each that is wanted: about one in four is drivable."""

Footprints = tuple[VehicleConfig, ...]
"""Of the vehicles that must be able to drive on a street."""

LEAST_SHARE = 1 / 50
"""Share of the drawn streets that must be drivable."""


def build_road(scenario: ScenarioConfig, device: torch.device | str = "cpu") -> Road:
    """The streets of a scenario by their numbers, see `ScenarioConfig.held_out_streets`."""
    if scenario.map is not None:
        return build_map_road(scenario.map, map_rules(scenario), torch.device(device))
    return _built(scenario.road, scenario.streets, _footprints(scenario), torch.device(device))


def draw_streets(scenario: ScenarioConfig) -> tuple[StreetConfig, ...]:
    """The streets of a scenario by their numbers, from 1 on: those of the training, then those that are held out.

    A map's street is none of them.
    """
    return () if scenario.map is not None else _drawn(scenario.road, scenario.streets, _footprints(scenario))


def _footprints(scenario: ScenarioConfig) -> Footprints:
    """Of the ego and of the largest vehicle of every kind, without those that are within another one."""
    sizes = dict.fromkeys([scenario.vehicle, *scenario.largest_of_kinds.values()])
    return tuple(size for size in sizes if not any(size.is_within(other) for other in sizes if other != size))


@lru_cache(maxsize=4)  # a config's check and its game need the same road
def _built(road: RoadConfig, streets: StreetsConfig, footprints: Footprints, device: torch.device) -> Road:
    configs = _drawn(road, streets, footprints)
    if len(configs) == 1 and configs[0].is_closed_form:
        return OneStreet(configs[0], device)
    return _by_table(configs, device)


@lru_cache(maxsize=4)
def _drawn(road: RoadConfig, streets: StreetsConfig, footprints: Footprints) -> tuple[StreetConfig, ...]:
    if not road.varies:
        return (_checked(road.street, streets, footprints),)
    parts = ((streets.n_training, "training streets"), (streets.n_held_out, "held-out streets"))
    return tuple(
        street
        for n, name in parts
        for street in _drivable_streets(road, streets, footprints, n, generator(streets.seed, name))
    )


def _checked(street: StreetConfig, streets: StreetsConfig, footprints: Footprints) -> StreetConfig:
    """The only street; UserError where its width changes and its routes break the requirements of `streets`."""
    if street.width_changes and not bool(_is_good(_by_table((street,), "cpu"), streets, footprints)):
        widths = [street.width_m, *(change.width_m for change in street.width_changes)]
        got = ", ".join(f"{width_m:g}" for width_m in widths)
        raise UserError(f"scenario.road.width_changes must leave {_rule(streets)}, got widths of {got} m")
    return street


def _is_good(table: Streets, streets: StreetsConfig, footprints: Footprints) -> torch.Tensor:
    """[B] bool: the largest vehicle of every kind can drive on a street by the requirements of `streets`."""
    good = [is_drivable(table, size, streets.clearance_m, streets.curvature_max_1pm) for size in footprints]
    return torch.stack(good).all(0)


def _reach_m(configs: Sequence[StreetConfig]) -> float:
    return BEYOND_M + max(config.reach_m for config in configs)


def _by_table(configs: Sequence[StreetConfig], device: torch.device | str, reach_m: float | None = None) -> Streets:
    """reach_m: of the tables; None = as far as the streets themselves ask for"""
    reach_m = _reach_m(configs) if reach_m is None else reach_m
    return Streets([drawn_street(config, reach_m) for config in configs], device)


def _drivable_streets(
    road: RoadConfig, streets: StreetsConfig, footprints: Footprints, n: int, random: torch.Generator
) -> list[StreetConfig]:
    """`n` streets whose routes keep to the requirements of `streets`; UserError where too few do."""
    found: list[StreetConfig] = []
    n_drawn, n_checked = 0, min(N_DRAWN, N_CHECKED_PER_STREET * n)
    while len(found) >= n_drawn * LEAST_SHARE:
        drawn = road.draw(N_DRAWN, random)
        n_drawn, reach_m = n_drawn + len(drawn), _reach_m(drawn)
        for first in range(0, N_DRAWN, n_checked):
            part = drawn[first : first + n_checked]
            is_good = _is_good(_by_table(part, "cpu", reach_m), streets, footprints)
            found += [street for street, good in zip(part, is_good.tolist(), strict=True) if good]
            if len(found) >= n:
                return found[:n]
    n_found = f"{len(found)} of {n_drawn} do"
    raise UserError(f"scenario.road must leave streets with {_rule(streets)}, {n_found}: {road.intervals}")


def _rule(streets: StreetsConfig) -> str:
    """What routes must keep to, for a message."""
    return f"streets.clearance_m = {streets.clearance_m} and curvature_max_1pm = {streets.curvature_max_1pm}"
