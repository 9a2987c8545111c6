"""Measures of a street, made by ways of their own for tests."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from negopipe.maps import MapStreet
from negopipe.maps.boxes import corners_of_parked
from negopipe.maps.street import STEP_M, to_line

Array = NDArray[np.float64]


def kerbs(street: MapStreet) -> tuple[Array, Array]:
    """Left and right kerb, [K, 2] each."""
    normal = np.stack([-np.sin(street.heading), np.cos(street.heading)], axis=-1)
    return street.points + street.left_m[:, None] * normal, street.points - street.right_m[:, None] * normal


def distance_to(polyline: Array, points: Array) -> Array:
    """Distance of each point from a polyline, edge by edge."""
    best = np.full(len(points), np.inf)
    for a, b in pairwise(polyline):
        edge = b - a
        share = np.clip((points - a) @ edge / max(float(edge @ edge), 1e-12), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - a - share[:, None] * edge, axis=1))
    return best


def integrated(street: MapStreet) -> Array:
    """Points from the headings alone, by a fine trapezoidal rule."""
    fine = np.arange(0, street.length_m + 1e-9, STEP_M / 50)
    curvature = np.interp(fine, street.sigma, street.curvature)
    turned = np.concatenate([[0], np.cumsum((curvature[1:] + curvature[:-1]) / 2 * np.diff(fine))])
    heading = street.heading[0] + turned
    tangent = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    steps = (tangent[1:] + tangent[:-1]) / 2 * np.diff(fine)[:, None]
    points = street.points[0] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.asarray(points[::50])


def assert_is_sound(street: MapStreet) -> None:
    """What every street must hold."""
    count = len(street.points)
    assert street.points.shape == (count, 2)
    assert street.length_m == STEP_M * (count - 1)
    for values in (street.heading, street.curvature, street.left_m, street.right_m):
        assert values.shape == (count,)
        assert np.isfinite(values).all()
    chords = np.linalg.norm(np.diff(street.points, axis=0), axis=1)
    assert np.abs(chords - STEP_M).max() < 1e-3
    assert np.abs(np.diff(street.heading) - STEP_M * (street.curvature[1:] + street.curvature[:-1]) / 2).max() < 1e-9
    assert np.linalg.norm(integrated(street) - street.points, axis=1).max() < 0.01
    assert street.left_m.min() > 0
    assert street.right_m.min() > 0
    assert (1 - np.maximum(street.curvature * street.left_m, -street.curvature * street.right_m)).min() > 0.2
    assert_parked_apart(street)


def assert_parked_apart(street: MapStreet) -> None:
    """No parked vehicle overlaps another one (by samples of its outline and middle) or covers the line's place."""
    shapes = corners_of_parked(street)
    inner = np.linspace(0, 1, 21)
    for n, shape in enumerate(shapes):
        closed = np.concatenate([shape, shape[:1]])
        outline = np.concatenate([a + inner[:, None] * (b - a) for a, b in pairwise(closed)])
        samples = np.concatenate([outline, shape.mean(0) + 0.5 * (outline - shape.mean(0))])
        for m, other in enumerate(shapes):
            if m != n:
                edges = np.roll(other, -1, 0) - other
                away = samples[:, None] - other
                inside = edges[:, 0] * away[..., 1] - edges[:, 1] * away[..., 0] > 1e-6
                assert not inside.all(axis=1).any(), f"vehicles {n} and {m} overlap"
        assert np.abs(to_line(street, outline)[1]).min() > 0.05, f"vehicle {n} stands on the line"
