"""Transverse Mercator projection of WGS84 with true scale on the central meridian of the map itself.

Krueger's series to the third order in the third flattening, which is exact to a millimetre within hundreds of km.
Unlike UTM, the central meridian runs through the map and the scale there is 1, so that lengths are true metres.
"""

import numpy as np

from negopipe.maps.street import Array

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563


def project(latitude_deg: Array, longitude_deg: Array, origin: tuple[float, float]) -> Array:
    """Metres east and north [N, 2] of the origin (latitude, longitude), all in degrees, [N]."""
    n = FLATTENING / (2 - FLATTENING)
    scale = SEMI_MAJOR_M / (1 + n) * (1 + n**2 / 4)
    terms = (n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240)
    sine = 2 * np.sqrt(n) / (1 + n)

    def unscaled(latitude: Array, longitude: Array) -> tuple[Array, Array]:
        phi, east = np.radians(latitude), np.radians(longitude)
        t = np.sinh(np.arctanh(np.sin(phi)) - sine * np.arctanh(sine * np.sin(phi)))
        xi, eta = np.arctan2(t, np.cos(east)), np.arctanh(np.sin(east) / np.sqrt(1 + t**2))
        series = [(a, 2 * (j + 1)) for j, a in enumerate(terms)]
        north = xi + sum(a * np.sin(k * xi) * np.cosh(k * eta) for a, k in series)
        return eta + sum(a * np.cos(k * xi) * np.sinh(k * eta) for a, k in series), north

    x, y = unscaled(latitude_deg, longitude_deg - origin[1])
    _, y_origin = unscaled(np.array([origin[0]]), np.zeros(1))
    return scale * np.stack([x, y - y_origin], axis=-1)
