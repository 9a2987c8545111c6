"""A street of a map made to a street to drive on: narrow places found, routes laid, all sampled at the knots.

Three frames: arc length `along` of the map's line from its first point; sigma, which is 0 in the middle from the first
narrow place to the last one; the world, which has its origin there and its x axis along the line.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from negopipe.errors import UserError
from negopipe.maps.street import STEP_M, MapStreet, free_sides
from negopipe.simulation.knot_tables import BEYOND_M, KNOT_M, knots
from negopipe.simulation.smoothstep import smoothstep
from negopipe.simulation.street import Street

TAPER_M = 10.0
"""Length over which the line turns straight beyond the ends of the map, m."""

Array = np.ndarray


class Footprint(Protocol):
    """Length and width of a vehicle, m."""

    @property
    def length_m(self) -> float: ...

    @property
    def width_m(self) -> float: ...


@dataclass(frozen=True)
class MapRules:
    """Sizes in metres by which a map becomes a street.

    vehicle: footprint of every vehicle
    swerve_m: length over which a route changes its offset
    lane_m: distance of a route from what bounds the road on the right, where there is room for it
    target_m: distance beyond the corridor at which a vehicle has arrived
    before_m, behind_m: length that the tasks need before the first and behind the last narrow place
    clearance_m: room beside a vehicle that drives on its route
    curvature_max_1pm: sharpest bend of a route, 1/m
    """

    vehicle: Footprint
    swerve_m: float
    lane_m: float
    target_m: float
    before_m: float
    behind_m: float
    clearance_m: float
    curvature_max_1pm: float

    @property
    def one_needs_m(self) -> float:
        """Free width that a vehicle needs."""
        return self.vehicle.width_m + 2 * self.clearance_m

    def two_need_m(self, curvature: Array) -> Array:
        """[K] m: free width that two vehicles need beside each other; in a bend their ends swing out."""
        return 2 * self.vehicle.width_m + 3 * self.clearance_m + 2 * self.swing_m(curvature)

    def swing_m(self, curvature: Array) -> Array:
        """[K] m: distance by which the ends of a vehicle swing out of its way in a bend."""
        return np.abs(curvature) * self.vehicle.length_m**2 / 8


def narrow_places(street: MapStreet, rules: MapRules, path: Path) -> Array:
    """[M, 2], m along: stretches in which two vehicles do not fit beside each other, nearer ones joined."""
    left, right = free_sides(street)
    width = left + right
    tightest = int(width.argmin())
    if width[tightest] < rules.one_needs_m:
        raise UserError(
            f"{path}: {street.sigma[tightest]:.1f} m along the street a free width of {width[tightest]:.2f} m is left; "
            f"a vehicle needs {rules.one_needs_m:.2f} m by scenario.vehicle.width_m and scenario.streets.clearance_m"
        )
    is_narrow = width < rules.two_need_m(street.curvature)
    if not is_narrow.any():
        raise UserError(
            f"{path}: its street has no narrow place, the free width is {width.min():.2f} to {width.max():.2f} m; "
            f"less than {rules.two_need_m(np.zeros(())):.2f} m is needed somewhere (scenario.map.rows parks vehicles)"
        )
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_narrow, [False]]).astype(int)))
    stretches = street.sigma[np.stack([edges[::2], edges[1::2] - 1], axis=-1)]
    is_apart = stretches[1:, 0] - stretches[:-1, 1] >= 2 * rules.swerve_m
    firsts = np.concatenate([[True], is_apart])
    lasts = np.concatenate([is_apart, [True]])
    return np.stack([stretches[firsts, 0], stretches[lasts, 1]], axis=-1)


def street_of_map(street: MapStreet, rules: MapRules, path: Path) -> Street:
    """The street with knots from end to end; beyond the map's ends it goes on straight and as wide as there.

    Parked vehicles become the rectangles along the line that bound them. UserError: no narrow place, one too narrow for
    a vehicle, too little street before or behind them.
    """
    narrow = narrow_places(street, rules, path)
    _check_length(street, narrow, rules, path)
    middle = float(narrow[0, 0] + narrow[-1, 1]) / 2
    beyond = max(TAPER_M, rules.swerve_m) + BEYOND_M
    sigma = knots(max(middle, street.length_m - middle) + beyond)
    along = sigma + middle

    def at_knots(values: Array) -> Array:
        return np.interp(along, street.sigma, values)

    outside = np.maximum(np.maximum(-along, along - street.length_m), 0)
    taper = 1 - smoothstep(outside / TAPER_M)[0]
    curvature = at_knots(street.curvature) * taper
    left, right = (at_knots(side) for side in free_sides(street))
    targets = _targets(along, left, right, curvature, narrow, rules)
    return Street(
        curvature=np.stack([curvature, np.gradient(curvature, KNOT_M)], axis=-1),
        kerbs=np.stack([at_knots(street.right_m), at_knots(street.left_m)]),
        routes=np.stack([_smoothed(sigma, target, rules.swerve_m) for target in targets]),
        parked=_bounding(street.parked) - np.array([middle, 0, 0, 0]),
        narrow=narrow - middle,
        target_m=rules.target_m,
    )


def cut(street: MapStreet, first_m: float, last_m: float) -> MapStreet:
    """The part of a street from the first to the last arc length, rounded inwards to the points of its line."""
    first = max(int(np.ceil(first_m / STEP_M)), 0)
    end = min(int(np.floor(last_m / STEP_M)), len(street.points) - 1) + 1
    names = ("points", "heading", "curvature", "left_m", "right_m")
    begin_m, end_m = STEP_M * first, STEP_M * (end - 1)
    parked = street.parked[(street.parked[:, 0] >= begin_m) & (street.parked[:, 0] <= end_m)]
    parts = {name: getattr(street, name)[first:end] for name in names}
    return replace(street, **parts, parked=parked - np.array([begin_m, 0, 0, 0, 0]))


def _check_length(street: MapStreet, narrow: Array, rules: MapRules, path: Path) -> None:
    """UserError unless there is room to start and to arrive at both ends."""
    ends = (
        ("before its first", narrow[0, 0], rules.before_m),
        ("behind its last", street.length_m - narrow[-1, 1], rules.behind_m),
    )
    for where, has_m, needs_m in ends:
        if has_m < needs_m:
            raise UserError(
                f"{path}: its street is {has_m:.1f} m long {where} narrow place; start distances and "
                f"scenario.road.target_distance_m need {needs_m:.1f} m, {needs_m - has_m:.1f} m are missing"
            )


def _bounding(parked: Array) -> Array:
    """[P, 4], arc length, offset, length and width of the rectangles along the line that bound vehicles [P, 5]."""
    at, d, yaw, length, width = parked.T
    cos, sin = np.abs(np.cos(yaw)), np.abs(np.sin(yaw))
    return np.stack([at, d, length * cos + width * sin, length * sin + width * cos], axis=-1)


def _targets(along: Array, left: Array, right: Array, curvature: Array, narrow: Array, rules: MapRules) -> Array:
    """[2, K], m to the line's left: what the routes along the line and against it aim at before they are smoothed.

    Outside narrow places it is the lane, inside the middle of the free space. A narrow place begins half a swerve
    before its mouth, so that a smoothed step ends there. Free sides count that come within half a swerve and half a
    vehicle, so that a smoothed route keeps clear of them.
    """
    within = int(np.ceil((rules.swerve_m / 2 + rules.vehicle.length_m / 2 + rules.clearance_m) / KNOT_M))
    left, right = _least(left, within), _least(right, within)
    swing = -_least(-rules.swing_m(curvature), within)
    least = rules.one_needs_m / 2 + swing
    lane = np.minimum(rules.lane_m, np.maximum((left + right) / 4, least))
    targets = np.stack([lane - right, left - lane])
    middle = (left - right) / 2
    for first, last in narrow:
        is_inside = (along >= first - rules.swerve_m / 2) & (along <= last + rules.swerve_m / 2)
        targets[:, is_inside] = np.interp(np.clip(along[is_inside], first, last), along, middle)
    return targets


def _least(values: Array, n: int) -> Array:
    """[K]: the least of each value and its n neighbours to both sides."""
    padded = np.pad(values, n, mode="edge")
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * n + 1).min(-1))


def _smoothed(sigma: Array, target: Array, length_m: float) -> Array:
    """[K, 3]: a smooth step of `length_m` for every change of the target [K], with its derivatives."""
    x = (sigma[:, None] - (sigma[:-1] + KNOT_M / 2)) / length_m + 0.5
    steps = np.stack(smoothstep(x), axis=1)  # [K, 3, K - 1]
    routes = steps @ np.diff(target) / length_m ** np.arange(3)
    routes[:, 0] += target[0]
    return np.asarray(routes)
