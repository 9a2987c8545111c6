"""An encounter's street and vehicles as JSON values for the page, which draws them."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from negopipe.evaluation.encounter import horizon_text
from negopipe.play.arena import Arena
from negopipe.report.scene import GROUND, PARKED, ROAD, SOCIAL, Scene, scene_of
from negopipe.report.style import ADAPTIVE_COLOR, CORRIDOR, INK, OUTCOME_COLORS, QUIET, horizon_color
from negopipe.simulation.road import Road
from negopipe.simulation.state import EGO, NEAREST, Task

DIGITS = 3
"""Digits of a metre and a radian that a drawing needs."""
MARGIN_M = 5.0
"""Length of street that is shown behind the outermost start and target, m."""
VEHICLES = {"opponent": EGO, "person": NEAREST}
"""Index of the vehicles on the page."""


def scenery(arena: Arena, task: Task) -> dict[str, Any]:
    """What stays the same in an encounter.

    street: number and, in the world frame (m, rad), the arrays of `negopipe.report.scene.Scene`
    person_way: +1 where the person drives along the line, else -1
    target_sigma_m, reach_m: places of the targets of `VEHICLES` and of the outermost start or target along the line
    size_m: length and width of each vehicle; horizons: of the opponent and of a person who drives by a horizon
    has_second_person: whether a second person drives the opponent's car
    """
    config, road = arena.config, arena.game.simulator.road
    way = task.direction[:, NEAREST]
    number, half_m = int(way.abs()[0]), float(road.corridor_m(way)) / 2
    sign = int(torch.sign(way)[0])
    target_m = {seat: _target_sigma_m(road, task.direction[:, vehicle]) for seat, vehicle in VEHICLES.items()}
    start_m = float(task.start_distance.max()) + half_m
    return {
        "street": {"number": number} | _street(scene_of(road, number, config.planner.horizon_s)),
        "person_way": sign,
        "target_sigma_m": target_m,
        "reach_m": round(max(start_m, *map(abs, target_m.values())) + MARGIN_M, DIGITS),
        "size_m": torch.stack([task.length[0], task.width[0]], -1).tolist(),
        "desired_speed_mps": float(task.desired_speed[0, NEAREST]),
        "limit_s": config.scenario.episode_steps * config.scenario.dt_s,
        "dt_s": config.scenario.dt_s,
        "plan_s": config.planner.horizon_s,
        "horizons": [horizon_text(horizon_s) for horizon_s in arena.horizons_s],
        "has_second_person": arena.has_second_person,
        "horizon_colors": {horizon_text(value): horizon_color(value) for value in arena.horizons_s},
    }


def colors() -> dict[str, str]:
    """Colours of the report's films."""
    fixed = {"ground": GROUND, "road": ROAD, "corridor": CORRIDOR, "parked": PARKED, "ink": INK, "quiet": QUIET}
    return fixed | {"opponent": ADAPTIVE_COLOR, "person": SOCIAL} | OUTCOME_COLORS


def _target_sigma_m(road: Road, way: Tensor) -> float:
    """Place of a target along the line; way: [1], the direction of the vehicle."""
    return round(float(torch.sign(way)) * (float(road.target_s(way)) - float(road.corridor_m(way)) / 2), DIGITS)


def _street(scene: Scene) -> dict[str, Any]:
    is_there = scene.parked_cars[:, 3] > 0
    return {
        "parked": _rounded(scene.parked_cars[is_there]),
        "line": _rounded(scene.line_m),
        "kerbs": _rounded(scene.kerbs_m),
        "corridors": [_rounded(each) for each in scene.corridors_m],
        "route_d": _rounded(scene.route_d_m),
    }


def _rounded(values: np.ndarray) -> Any:
    return values.astype(np.float64).round(DIGITS).tolist()
