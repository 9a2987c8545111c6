"""Reference line of a street: the middle between two kerbs, smoothed, and the kerbs' distances from it.

The line is a curvature that is linear between knots, integrated from a start pose. Start and knots are fitted to the
middle by Gauss-Newton steps on the lateral distances, with a penalty on the change of curvature. Heading, curvature and
points therefore agree by construction.
"""

from dataclasses import dataclass

import numpy as np

from negopipe.maps.street import STEP_M, Array, normals

KNOT_M = 4.0
"""Distance of the knots of the curvature along the line."""
SMOOTH_M = 15.0
"""Wavelength of the middle's wiggles below which the line smooths them away."""
GAUSS_NEWTON_STEPS = 20
"""Upper bound on the steps of one fit; real streets settle in about six."""
REFITS = 3
"""Times that the line is fitted to the middle between the kerbs as seen along the normals of the line before."""
END_MARGIN_M = 0.05
"""Length by which kerbs are extended at the street's ends, so that ends square to the line keep their points."""
SETTLED = 1e-6
"""Change of pose (m, rad) and curvature (1/m) below which a fit has settled."""
GAUSS = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
GAUSS_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18


@dataclass(frozen=True)
class Line:
    """Curve of K points `STEP_M` apart along its arc: points [K, 2], heading [K], curvature [K]."""

    points: Array
    heading: Array
    curvature: Array

    def part(self, chosen: slice) -> "Line":
        return Line(self.points[chosen], self.heading[chosen], self.curvature[chosen])


def integrate(start: Array, curvature: Array) -> Line:
    """Line from a start pose (x, y, heading) [3] with curvature [K], linear between the points.

    Headings are exact; points come from three-point Gauss quadrature of their cosine and sine between the points.
    """
    change = np.diff(curvature)
    heading = start[2] + np.concatenate([[0.0], np.cumsum(STEP_M * (curvature[:-1] + change / 2))])
    u = STEP_M * GAUSS
    between = heading[:-1, None] + curvature[:-1, None] * u + change[:, None] * u**2 / (2 * STEP_M)
    steps = STEP_M * np.stack([np.cos(between) @ GAUSS_WEIGHTS, np.sin(between) @ GAUSS_WEIGHTS], axis=-1)
    points = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return Line(points, heading, curvature)


def arc_lengths(polyline: Array) -> Array:
    """Arc length of every vertex of a polyline [N, 2], [N]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(polyline, axis=0), axis=1))])


def resample(polyline: Array, at: Array) -> Array:
    """Points [N, 2] at shares `at` [N] of a polyline's length, 0 to 1."""
    along = arc_lengths(polyline)
    return np.stack([np.interp(at * along[-1], along, polyline[:, axis]) for axis in (0, 1)], axis=-1)


def evenly(polyline: Array, step_m: float) -> Array:
    """Points of a polyline about `step_m` apart, its ends included."""
    count = max(round(float(arc_lengths(polyline)[-1]) / step_m), 1)
    return resample(polyline, np.linspace(0, 1, count + 1))


def rough_middle(lefts: list[Array], rights: list[Array]) -> Array:
    """Polyline halfway between left and right kerbs, given piece by piece; equal shares of both kerbs are paired."""
    shares = np.linspace(0, 1, 21)
    middles = [
        (resample(left, shares) + resample(right, shares)) / 2 for left, right in zip(lefts, rights, strict=True)
    ]
    return without_repeats(np.concatenate(middles))


def without_repeats(polyline: Array) -> Array:
    """Polyline without vertices less than a millimetre from the one before."""
    kept = np.concatenate([[True], np.linalg.norm(np.diff(polyline, axis=0), axis=1) > 1e-3])
    return np.asarray(polyline[kept])


def fit(target: Array) -> Line:
    """Smooth line along a polyline [N, 2], from its first point, as long as the polyline."""
    target = evenly(target, STEP_M)
    along = STEP_M * np.arange(len(target))
    knots = np.linspace(0, along[-1], max(round(along[-1] / KNOT_M), 1) + 1)
    hats = np.stack([np.interp(along, knots, row) for row in np.eye(len(knots))], axis=1)
    start, bends = _first_guess(target, knots)
    turning = _cumulated(hats)
    roughness = np.diff(np.eye(len(knots)), axis=0) * np.sqrt((2 * np.pi / SMOOTH_M) ** -6 / knots[1])
    penalty = np.concatenate([np.zeros((len(knots) - 1, 3)), roughness], axis=1)
    for _ in range(GAUSS_NEWTON_STEPS):
        line = integrate(start, hats @ bends)
        lateral, slope = _residuals(line, turning, target)
        system, wrong = np.concatenate([slope, penalty]), np.concatenate([lateral, roughness @ bends])
        change = np.linalg.solve(system.T @ system, -system.T @ wrong)
        start, bends = start + change[:3], bends + change[3:]
        if np.abs(change[:3]).max() < SETTLED and np.abs(change[3:]).max() < SETTLED:
            break
    return integrate(start, hats @ bends)


def _residuals(line: Line, turning: Array, target: Array) -> tuple[Array, Array]:
    """Weighted lateral distances of a line from its target, and their derivatives by start pose and knots.

    The last one is the distance of the first point ahead of the target's. `turning` [K, J] is the heading's change by
    each knot's curvature.
    """
    normal = normals(line.heading)
    lateral = _signed_distances(line.points, normal, target)
    arm = line.points - line.points[0]
    lever = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
    sweep = _cumulated(normal[:, :, None] * turning[:, None])
    by_knots = normal[:, :1] * sweep[:, 0] + normal[:, 1:] * sweep[:, 1]
    slope = np.sqrt(STEP_M) * np.concatenate([normal, lever[:, None], by_knots], axis=1)
    tangent = np.array([np.cos(line.heading[0]), np.sin(line.heading[0])])
    anchor = np.concatenate([tangent, np.zeros(slope.shape[1] - 2)])
    ahead = tangent @ (line.points[0] - target[0])
    return np.append(np.sqrt(STEP_M) * lateral, ahead), np.concatenate([slope, anchor[None]])


def _cumulated(values: Array) -> Array:
    """Integral of values [K, ...] at the points of a line from its start, by the trapezoidal rule."""
    zero = np.zeros((1, *values.shape[1:]))
    return np.concatenate([zero, np.cumsum(STEP_M * (values[1:] + values[:-1]) / 2, axis=0)])


def _first_guess(target: Array, knots: Array) -> tuple[Array, Array]:
    """Start pose [3] and curvature at the knots, from headings averaged over the smoothing length."""
    width = max(min(round(SMOOTH_M / STEP_M), len(target) // 4), 1)
    tangent = np.diff(target, axis=0)
    padded = np.concatenate([np.repeat(tangent[:1], width, 0), tangent, np.repeat(tangent[-1:], width, 0)])
    kernel = np.ones(2 * width + 1)
    mean = np.stack([np.convolve(padded[:, axis], kernel, mode="valid") for axis in (0, 1)], axis=-1)
    heading = np.unwrap(np.arctan2(mean[:, 1], mean[:, 0]))
    at = STEP_M * (np.arange(len(heading)) + 0.5)
    bends = np.gradient(np.interp(knots, at, heading), knots)
    return np.array([*target[0], heading[0]]), bends


def _signed_distances(points: Array, normal: Array, polyline: Array) -> Array:
    """Lateral distance of points [K, 2] from their nearest places on a polyline, positive to its left, [K]."""
    squares = (points**2).sum(1)[:, None] - 2 * points @ polyline.T + (polyline**2).sum(1)
    nearest = np.clip(squares.argmin(axis=1), 1, len(polyline) - 2)[:, None] + np.array([-1, 0])
    first, edges = polyline[nearest], polyline[nearest + 1] - polyline[nearest]
    offset = points[:, None] - first
    share = np.clip((offset * edges).sum(-1) / (edges**2).sum(-1), 0, 1)
    away = offset - share[..., None] * edges
    closer = (away**2).sum(-1).argmin(axis=1)
    return np.asarray((away[np.arange(len(points)), closer] * normal).sum(-1))


def crossings(points: Array, normal: Array, polyline: Array) -> Array:
    """Signed distances [K, N - 1] along each point's normal to each edge of a polyline [N, 2]; NaN: no crossing."""
    first, edges = polyline[:-1], np.diff(polyline, axis=0)
    offset = first - points[:, None]
    area = normal[:, None, 0] * edges[:, 1] - normal[:, None, 1] * edges[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (offset[..., 0] * edges[:, 1] - offset[..., 1] * edges[:, 0]) / area
        share = (offset[..., 0] * normal[:, None, 1] - offset[..., 1] * normal[:, None, 0]) / area
    return np.where((share >= 0) & (share <= 1), away, np.nan)


def kerb_distances(line: Line, left: Array, right: Array) -> tuple[Array, Array]:
    """Distances [K] of the left and the right kerb along the line's normals; infinite where the normal meets none."""
    normal = normals(line.heading)
    to_left, to_right = crossings(line.points, normal, left), -crossings(line.points, normal, right)
    nearest = [np.where(away > 0, away, np.inf).min(axis=1) for away in (to_left, to_right)]
    return nearest[0], nearest[1]


def _longer(polyline: Array) -> Array:
    """Polyline extended at both ends by `END_MARGIN_M`."""
    before, after = polyline[0] - polyline[1], polyline[-1] - polyline[-2]
    ends = [
        end + END_MARGIN_M * step / np.linalg.norm(step) for end, step in ((polyline[0], before), (polyline[-1], after))
    ]
    return np.concatenate([ends[:1], polyline, ends[1:]])


def between_both(left_m: Array, right_m: Array) -> slice:
    """Points from the first to the last whose normal meets both kerbs."""
    both = np.flatnonzero(np.isfinite(left_m) & np.isfinite(right_m))
    return slice(int(both[0]), int(both[-1]) + 1) if len(both) else slice(0, 0)


def middle_line(lefts: list[Array], rights: list[Array]) -> tuple[Line, Array, Array]:
    """Smooth line in the middle between kerbs given piece by piece, and its distances to the left and right kerb.

    The distances are infinite where one kerb is missing inside the street.
    """
    left, right = (_longer(without_repeats(np.concatenate(kerb))) for kerb in (lefts, rights))
    line = fit(rough_middle(lefts, rights))
    for _ in range(REFITS):
        left_m, right_m = kerb_distances(line, left, right)
        met = np.isfinite(left_m) & np.isfinite(right_m)
        if met.sum() < 2:
            break
        shift = (left_m[met] - right_m[met]) / 2
        line = fit(without_repeats(line.points[met] + shift[:, None] * normals(line.heading[met])))
    left_m, right_m = kerb_distances(line, left, right)
    inside = between_both(left_m, right_m)
    return line.part(inside), left_m[inside], right_m[inside]
