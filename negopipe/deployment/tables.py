"""The tables of one street of any shape, of fixed size, as an exported decision reads them; NumPy alone.

They are those of `negopipe.simulation.streets.Streets`, filled up to the capacity of the export.
"""

from typing import NamedTuple

import numpy as np

from negopipe.errors import UserError
from negopipe.planner.parked_rows import NO_ROW, parked_rows
from negopipe.simulation.knot_tables import (
    GAUSS,
    KNOT_M,
    N_SEARCHED,
    Array,
    cubics,
    integrate,
    lines,
    narrow_by_way,
    nearest_kerbs,
    quintics,
    turned,
)
from negopipe.simulation.off_road import off_road_rows
from negopipe.simulation.street import Street

FAR_M = 1e4
"""Coordinate of boxes that fill up a table, m."""


class Capacity(NamedTuple):
    """Sizes of the tables: the largest street that an export serves.

    reach_m: distance from the corridor's middle up to which a street has knots; beyond it, it goes straight on
    n_narrow_places, n_parked, n_off_road: narrow places, parked cars, rectangles beyond the kerbs
    """

    reach_m: float
    n_narrow_places: int
    n_parked: int
    n_off_road: int

    @property
    def n_knots(self) -> int:
        """K, odd."""
        return 2 * round(self.reach_m / KNOT_M) + 1


class StreetTables(NamedTuple):
    """Tables of one street; float32, K knots, world frame with its origin in the corridor's middle.

    line_curvature: [4, K - 1], cubics of the line's curvature; line_pose: [7, K - 1], x, y, heading at the knots and
        these cubics; line_points: [2, K / 4], x, y of every fourth knot
    routes: [6, 2 (K - 1)], quintics of the routes along the line and against it
    kerbs: [2, 2 (K - 1)], lines of the right and the left kerb; near_kerbs: the same, each the nearest around
    corridor, target: [1] m, length of the corridor, s at which a vehicle has arrived
    narrow_places: [2, M, 2] m, by way; n_places: [1] int64
    parked, off_road: [1, P, 6] and [1, R, 6], fields of `Boxes`
    rows: [1, P, 4], rows of parked cars (`planner.parked_rows`)
    on_line: [P, 4], sigma, d, length, width of the cars on the road
    """

    line_curvature: Array
    line_pose: Array
    line_points: Array
    routes: Array
    kerbs: Array
    near_kerbs: Array
    corridor: Array
    target: Array
    narrow_places: Array
    n_places: Array
    parked: Array
    off_road: Array
    rows: Array
    on_line: Array


def street_tables(street: Street, capacity: Capacity, room_m: float) -> StreetTables:
    """Tables of a street; UserError where it is larger than the export's capacity.

    room_m: width that a vehicle needs between two parked cars, for a straight street
    """
    _check(street, capacity)
    missing = (capacity.n_knots - len(street.curvature)) // 2
    curvature = np.pad(street.curvature, ((missing, missing), (0, 0)))
    kerbs = np.pad(street.kerbs, ((0, 0), (missing, missing)), mode="edge")
    cubic = cubics(curvature[None, :, 0], curvature[None, :, 1])
    at_knots = integrate(cubic)
    x, y, heading = np.moveaxis(at_knots[:, :-1], -1, 0)
    length_m = street.narrow[-1, 1] - street.narrow[0, 0]
    rows = parked_rows(street.on_road, street.is_straight, room_m)
    nowhere = (FAR_M, FAR_M, 1.0, 0.0, 0.0, 0.0)
    single = {
        "line_curvature": cubic.reshape(4, -1),
        "line_pose": np.stack([x, y, heading, *cubic]).reshape(7, -1),
        "line_points": np.stack([x[0], y[0]])[:, ::N_SEARCHED],
        "routes": quintics(_padded_routes(street.routes, missing)).reshape(6, -1),
        "kerbs": lines(kerbs).reshape(2, -1),
        "near_kerbs": lines(nearest_kerbs(kerbs)).reshape(2, -1),
        "corridor": np.array([length_m]),
        "target": np.array([length_m + street.target_m]),
        "narrow_places": narrow_by_way(street.narrow, capacity.n_narrow_places),
        "parked": _filled(_boxes(_in_world(street.parked, cubic, at_knots)), capacity.n_parked, nowhere)[None],
        "off_road": _filled(_boxes(_beyond(at_knots[0], kerbs, capacity)), capacity.n_off_road, nowhere)[None],
        "rows": _filled(np.array(rows).reshape(-1, 4), capacity.n_parked, NO_ROW)[None],
        "on_line": _filled(np.array(street.on_road).reshape(-1, 4), capacity.n_parked, (FAR_M, 0.0, 0.0, 0.0)),
    }
    n_places = np.array([len(street.narrow)], dtype=np.int64)
    return StreetTables(**{name: table.astype(np.float32) for name, table in single.items()}, n_places=n_places)


def _check(street: Street, capacity: Capacity) -> None:
    """UserError where something of the street does not fit."""
    sizes = {
        "knots": (len(street.curvature), capacity.n_knots),
        "narrow places": (len(street.narrow), capacity.n_narrow_places),
        "parked vehicles": (len(street.parked), capacity.n_parked),
    }
    for name, (has, most) in sizes.items():
        if has > most:
            raise UserError(f"the street must have at most {most} {name} for this export, got {has}")
    if len(street.narrow) == 0:
        raise UserError("the street must have a corridor (a narrow place), got none")


def _beyond(line: Array, kerbs: Array, capacity: Capacity) -> Array:
    rows = off_road_rows(line, kerbs)
    if len(rows) > capacity.n_off_road:
        most = f"at most {capacity.n_off_road} rectangles beyond its kerbs for this export"
        raise UserError(f"the street must bend so little that it has {most}, got {len(rows)}")
    return rows


def _padded_routes(routes: Array, n: int) -> Array:
    """[2, K, 3]: n more knots at both ends, at which the routes go on with the same offset."""
    padded = np.pad(routes, ((0, 0), (n, n), (0, 0)), mode="edge")
    padded[:, :n, 1:] = padded[:, len(padded[0]) - n :, 1:] = 0
    return padded


def _filled(rows: Array, n: int, filling: tuple[float, ...]) -> Array:
    """[n, ...]: the rows, and `filling` behind them."""
    return np.concatenate([rows, np.tile(np.array(filling), (n - len(rows), 1))])


def _boxes(rows: Array) -> Array:
    """[N, 6], fields of `Boxes`, from x, y, yaw, length, width [N, 5]."""
    x, y, yaw, length, width = rows.T
    return np.stack([x, y, np.cos(yaw), np.sin(yaw), length / 2, width / 2], axis=-1)


def _in_world(parked: Array, cubic: Array, at_knots: Array) -> Array:
    """[P, 5]: x, y, yaw, length, width of parked cars [P, 4] along the line's tangent."""
    sigma, d, length, width = parked.T
    interval = np.clip(np.floor(sigma / KNOT_M + cubic.shape[2] / 2), 0, cubic.shape[2] - 1).astype(int)
    ahead = sigma - (interval - cubic.shape[2] / 2) * KNOT_M
    x, y, heading = at_knots[0, interval].T
    curvature = cubic[:, 0, interval]
    for node, weight in GAUSS:
        between = heading + turned(curvature, node * ahead)
        x, y = x + weight * ahead * np.cos(between), y + weight * ahead * np.sin(between)
    yaw = heading + turned(curvature, ahead)
    return np.stack([x - d * np.sin(yaw), y + d * np.cos(yaw), yaw, length, width], axis=-1)
