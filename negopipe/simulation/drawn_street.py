"""A drawn street, sampled at knots along its line."""

import numpy as np
import torch

from negopipe.simulation.knot_tables import Array, knots
from negopipe.simulation.one_street import park
from negopipe.simulation.reference_line import Course
from negopipe.simulation.road_config import StreetConfig
from negopipe.simulation.smoothstep import smoothstep
from negopipe.simulation.street import Street


def drawn_street(config: StreetConfig, reach_m: float) -> Street:
    """The street of a config, with knots up to `reach_m` from the corridor's middle."""
    line, sigma = Course(config.bends), torch.from_numpy(knots(reach_m))
    return Street(
        curvature=torch.stack(line.curvature(sigma), -1).numpy(),
        kerbs=np.tile(config.width_at(sigma).numpy() / 2, (2, 1)),
        routes=np.stack([_route(config, sigma.numpy(), way) for way in (1.0, -1.0)]),
        parked=park(config).double().numpy(),
        narrow=_narrow_places(config),
        target_m=config.target_distance_m,
    )


def _route(config: StreetConfig, sigma: Array, way: float) -> Array:
    """[K, 3]: the route of one way in the line's frame: a step for every change of the offset it aims at."""
    d = np.zeros((len(sigma), 3))
    lane_m = -way * config.lane_offset_m
    d[:, 0] = lane_m
    for middle_m, rise_m in _steps(config, lane_m):
        x = torch.from_numpy((sigma - middle_m) / config.swerve_length_m + 0.5)
        for order, value in enumerate(smoothstep(x)):
            d[:, order] += rise_m * value.numpy() / config.swerve_length_m**order
    return d


def _steps(config: StreetConfig, lane_m: float) -> list[tuple[float, float]]:
    """sigma of the middle of each step of a route, m, and how far it leads to the left, m.

    A step ends at the mouth, and the lane is taken again behind it. Where two corridors are too near for that, the
    step from one to the other lies in the middle between them.
    """
    before_m = config.swerve_margin_m + config.swerve_length_m / 2
    steps, at_m = [], lane_m
    places = list(zip(config.corridors_m, config.gap_middles_m, strict=True))
    for index, ((first, last), middle_m) in enumerate(places):
        if index == 0 or _has_lane_between(config):
            steps.append((first - before_m, middle_m - at_m))
        else:
            steps.append((first - config.between_corridors_m / 2, middle_m - at_m))
        at_m = middle_m
        if index == len(places) - 1 or _has_lane_between(config):
            steps.append((last + before_m, lane_m - at_m))
            at_m = lane_m
    return steps


def _has_lane_between(config: StreetConfig) -> bool:
    """Whether routes reach their lanes between two corridors."""
    return config.between_corridors_m >= 2 * (config.swerve_margin_m + config.swerve_length_m)


def _narrow_places(config: StreetConfig) -> Array:
    """[M, 2]: the corridors; those without a lane between them are one narrow place."""
    corridors = np.array(config.corridors_m)
    return corridors if _has_lane_between(config) else np.array([[corridors[0, 0], corridors[-1, 1]]])
