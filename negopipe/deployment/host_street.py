"""A street as a host knows it, made to the tables that an exported decision reads; NumPy alone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from negopipe.deployment.messages import Array
from negopipe.deployment.settings import Settings
from negopipe.deployment.tables import street_tables
from negopipe.errors import UserError
from negopipe.maps.line import middle_line
from negopipe.maps.street import MapStreet, to_line, to_plane
from negopipe.simulation.map_street import narrow_places, street_of_map
from negopipe.simulation.street import Street

Tables = Mapping[str, Array]
"""Tables of a street by the names of `tables.StreetTables`, and what is computed from them."""

Surround = Callable[[Tables], Tables]
"""street.onnx: tables -> the places to wait and the view ahead, by name."""

NAME = Path("the street")
"""What error texts call a street without a file."""


@dataclass(frozen=True)
class HostStreet:
    """A street as the ego drives along it.

    tables: arguments of the exported decision
    direction: +1 along the street's line, -1 against it
    origin: [2] m, middle of the corridor in the host's frame; heading: rad, of the street's x axis there
    """

    tables: Tables
    direction: float
    origin: Array
    heading: float

    def to_street(self, poses: Array) -> Array:
        """Poses [..., 3 or more] of the host's frame in the street's; other columns stay."""
        away = poses[..., :2] - self.origin
        return self._turned(away, -self.heading, poses)

    def to_host(self, poses: Array) -> Array:
        """The inverse of `to_street`."""
        moved = self._turned(poses[..., :2], self.heading, poses)
        moved[..., :2] += self.origin
        return moved

    def aside_m(self, position: Array) -> float:
        """Distance of a place [2] of the street's frame from the points of the line, m."""
        x, y = self.tables["line_points"]
        return float(np.hypot(x - position[0], y - position[1]).min())

    @staticmethod
    def _turned(places: Array, angle: float, poses: Array) -> Array:
        cos, sin = np.cos(angle), np.sin(angle)
        turned = np.array(poses, dtype=np.float64)
        turned[..., 0] = cos * places[..., 0] - sin * places[..., 1]
        turned[..., 1] = sin * places[..., 0] + cos * places[..., 1]
        turned[..., 2] = (poses[..., 2] + angle + np.pi) % (2 * np.pi) - np.pi
        return turned


def host_street(
    street: Street, direction: float, origin: Array, heading: float, settings: Settings, surround: Surround
) -> HostStreet:
    """A sampled street with its place in the host's frame. UserError where it is beyond the export's capacity."""
    if direction not in (1.0, -1.0):
        raise UserError(f"direction must be 1 (along the street's line) or -1 (against it), got {direction}")
    tables = street_tables(street, settings.capacity, settings.room_m)._asdict()
    return HostStreet({**tables, **surround(tables)}, direction, np.asarray(origin, dtype=np.float64), heading)


def between_kerbs(left: Array, right: Array, parked: Array, settings: Settings, surround: Surround) -> HostStreet:
    """The street between two kerbs, driven along them.

    The reference line lies in the middle between the kerbs. Narrow places are where two vehicles do not fit beside each
    other, and routes are laid as on the streets of maps. UserError where there is no narrow place, or one that is too
    narrow for a vehicle.

    left, right: [N, 2] and [M, 2] m, the kerbs as polylines in the direction of driving, at least 10 m beyond the
        narrow places
    parked: [P, 5], x, y (m), yaw (rad), length, width (m) of the parked vehicles
    """
    for name, values, columns in (("left", left, 2), ("right", right, 2), ("parked", parked, 5)):
        if values.ndim != 2 or values.shape[1] != columns or not np.isfinite(values).all():
            raise UserError(f"{name} must be finite numbers of shape [n, {columns}], got {_found(values)}")
    for name, kerb in (("left", left), ("right", right)):
        if len(np.unique(kerb, axis=0)) < 2:
            raise UserError(f"{name} must be a kerb of at least 2 different points, got {len(kerb)} points")
    line, left_m, right_m = middle_line([left], [right])
    if len(line.points) < 2 or not (np.isfinite(left_m) & np.isfinite(right_m)).all():
        raise UserError("left and right must be kerbs that run beside each other without holes, got others")
    on_map = MapStreet(line.points, line.heading, line.curvature, left_m, right_m, np.zeros((0, 5)), "", "", "")
    if len(parked):
        sigma, d = to_line(on_map, parked[:, :2])
        heading = to_plane(on_map, sigma, d)[1]
        boxes = np.column_stack([sigma, d, parked[:, 2] - heading, parked[:, 3:]])
        on_map = MapStreet(
            line.points, line.heading, line.curvature, left_m, right_m, boxes[np.argsort(sigma)], "", "", ""
        )
    narrow = narrow_places(on_map, settings.rules, NAME)
    middle = (narrow[0, 0] + narrow[-1, 1]) / 2
    (origin,), (at,) = to_plane(on_map, np.array([middle]), np.zeros(1))
    return host_street(street_of_map(on_map, settings.rules, NAME), 1.0, origin, float(at), settings, surround)


def _found(values: Array) -> str:
    return f"shape {list(values.shape)}" if np.isfinite(values).all() else "NaN or infinity"
