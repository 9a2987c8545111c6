"""Safety of the recorded drives: gaps, times to collision, deceleration, jerk and avoidable collisions.

Axes as in `Trace`: T decisions, E episodes, V vehicles (column 0 is the ego).
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from negopipe.evaluation.metrics import running
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.simulation.geometry import Boxes, boxes_from_pose, overlap_depth, time_to_collision
from negopipe.simulation.state import AT_REST_MPS, EGO

AVOIDING_S = 2.0
"""Time before a collision at which braking to avoid it begins."""

SIZE_DIGITS = 6
"""Decimals of a size in metres, fewer than float32 has."""


class _Driven(NamedTuple):
    """Poses [T, 3] and speeds [T] of a vehicle, one step apart, and its length and width."""

    pose: np.ndarray
    speed: np.ndarray
    size: tuple[float, float]

    @property
    def last(self) -> "_Driven":
        """The vehicle at its last pose."""
        return self._replace(pose=self.pose[-1:])


def footprints(trace: Trace) -> Boxes:
    """Footprints of all vehicles at all times, fields [T+1, E, V] float64, world frame."""
    pose = np.concatenate([trace.position_m, trace.yaw_rad[..., None]], -1)
    return _footprints(torch.from_numpy(pose).double(), *(torch.from_numpy(size).double() for size in _sizes(trace)))


def smallest_gap(boxes: Boxes) -> np.ndarray:
    """[E] float64, m: smallest distance between the ego's footprint and a social one's; 0 where they collide."""
    return box_distance(agents(boxes, EGO, EGO + 1), agents(boxes, EGO + 1, None)).amin((0, 2)).numpy()


def smallest_ttc(trace: Trace, boxes: Boxes) -> np.ndarray:
    """[E] float64, s: smallest time to collision with a social vehicle if both kept their velocity, until the end of
    the episode; NaN where the vehicles were never on a collision course."""
    is_driven = np.concatenate([np.ones_like(trace.n_steps[None], bool), running(trace)])
    speed = torch.from_numpy(trace.speed_mps).double()
    velocity = torch.stack([speed * boxes.cos, speed * boxes.sin], -1)
    ego, social = agents(boxes, EGO, EGO + 1), agents(boxes, EGO + 1, None)
    closing = velocity[:, :, EGO + 1 :] - velocity[:, :, EGO : EGO + 1]
    ttc = time_to_collision(ego, social, *closing.unbind(-1))
    ttc = torch.where(torch.from_numpy(is_driven)[..., None], ttc, torch.inf)
    smallest = ttc.amin((0, 2)).numpy()
    return np.where(np.isfinite(smallest), smallest, np.nan)


def largest_decel_and_jerk(trace: Trace) -> tuple[np.ndarray, np.ndarray]:
    """Largest deceleration (m/s2) and largest absolute jerk (m/s3) of the ego until the end of the episode, [E] float64
    each, by differences of its speed from decision to decision."""
    is_running = running(trace)
    accel = np.diff(trace.speed_mps[:, :, EGO].astype(np.float64), axis=0) / trace.dt_s
    jerk = np.abs(np.diff(accel, axis=0)) / trace.dt_s
    decel = np.where(is_running, -accel, 0.0).max(0)
    return decel.clip(min=0), np.where(is_running[1:], jerk, 0.0).max(0, initial=0.0)


def contact_speed(trace: Trace) -> np.ndarray:
    """[E] float64, m/s: speed of the ego at the collision that ended the episode, NaN without one."""
    speed = np.abs(trace.speed_mps[trace.n_steps, np.arange(len(trace.n_steps)), EGO].astype(np.float64))
    return np.where(trace.outcome == OUTCOMES.index("collision"), speed, np.nan)


def avoidable_by(trace: Trace, braking_mps2: float) -> np.ndarray:
    """[E] str: the vehicle that could have avoided a collision of the ego, ego | social | both | nobody.

    A vehicle could have avoided it if it was moving and would have come to rest without touching the other by braking
    on its path with `braking_mps2` from 2 s before. The other drives as it did and then straight on. A vehicle at rest
    that is hit is not at fault. alone: the ego touched no vehicle; none: no collision.
    """
    who = np.full(len(trace.n_steps), "none", dtype=object)
    for episode in np.flatnonzero(trace.outcome == OUTCOMES.index("collision")):
        who[episode] = _avoidable_by(trace, int(episode), braking_mps2)
    return who.astype(str)


def _avoidable_by(trace: Trace, episode: int, braking_mps2: float) -> str:
    end = int(trace.n_steps[episode])
    window = slice(max(0, end - round(AVOIDING_S / trace.dt_s)), end + 1)
    pose = np.concatenate([trace.position_m, trace.yaw_rad[..., None]], -1)[window, episode].astype(np.float64)
    speed = trace.speed_mps[window, episode].astype(np.float64)
    sizes = list(zip(*(size[episode].tolist() for size in _sizes(trace)), strict=True))
    driven = [_Driven(pose[:, agent], speed[:, agent], sizes[agent]) for agent in range(len(sizes))]
    is_hit = [_touches(driven[EGO].last, other.last) for other in driven[1:]]
    if not any(is_hit):
        return "alone"
    own, its = driven[EGO], driven[1 + is_hit.index(True)]
    by_ego, by_social = (
        abs(brakes.speed[0]) > AT_REST_MPS and not _hits_braking(brakes, other, trace.dt_s, braking_mps2)
        for brakes, other in ((own, its), (its, own))
    )
    return {(True, True): "both", (True, False): "ego", (False, True): "social"}.get((by_ego, by_social), "nobody")


def _hits_braking(brakes: _Driven, other: _Driven, dt_s: float, braking_mps2: float) -> bool:
    """A braking vehicle touches the other before it has come to rest."""
    start_mps = abs(brakes.speed[0])
    times = np.arange(0.0, start_mps / braking_mps2, dt_s)
    path, its = (_straight_on(each.pose, each.speed, dt_s, len(times)) for each in (brakes, other))
    driven = np.concatenate([[0.0], np.hypot(*np.diff(path[:, :2], axis=0).T).cumsum()])
    distance = np.minimum(start_mps * times - braking_mps2 * times**2 / 2, driven[: len(times)])
    columns = (path[:, 0], path[:, 1], np.unwrap(path[:, 2]))
    braked = np.stack([np.interp(distance, driven, column) for column in columns], -1)
    return _touches(brakes._replace(pose=braked), other._replace(pose=its[: len(times)]))


def _straight_on(pose: np.ndarray, speed: np.ndarray, dt_s: float, n: int) -> np.ndarray:
    """Poses [max(T, n), 3] of a vehicle that continues straight at its last speed."""
    x, y, yaw = pose[-1]
    ahead = speed[-1] * dt_s * np.arange(1, n - len(pose) + 1)
    beyond = np.stack([x + ahead * np.cos(yaw), y + ahead * np.sin(yaw), np.full_like(ahead, yaw)], -1)
    return np.concatenate([pose, beyond])


def _touches(a: _Driven, b: _Driven) -> bool:
    """Two vehicles overlap at some time."""
    first, second = (_footprints(torch.from_numpy(each.pose), *each.size) for each in (a, b))
    return bool((overlap_depth(first, second) > 0).any())


def _footprints(pose: Tensor, length: Tensor | float, width: Tensor | float) -> Boxes:
    """Footprints of vehicles at poses [..., 3], m, m, rad."""
    x, y, yaw = pose.unbind(-1)
    return boxes_from_pose(x, y, yaw, length, width)


def _sizes(trace: Trace) -> tuple[np.ndarray, np.ndarray]:
    """Lengths and widths [E, V]; shortest decimals, so that 1.8 m is 1.8 m in float64, too."""
    return tuple(np.round(size.astype(np.float64), SIZE_DIGITS) for size in (trace.length_m, trace.width_m))  # type: ignore[return-value]


def agents(boxes: Boxes, first: int, end: int | None) -> Boxes:
    """Boxes of the vehicles `first` to `end`, [..., V]."""
    return Boxes(*(field[..., first:end] if isinstance(field, Tensor) else field for field in boxes))  # type: ignore[arg-type]


def box_distance(a: Boxes, b: Boxes) -> Tensor:
    """Distance between oriented rectangles, [...] m, 0 where they overlap.

    One of the two nearest points of disjoint rectangles is a corner.
    """
    apart = torch.minimum(_distance_from_corners(a, b), _distance_from_corners(b, a))
    return torch.where(overlap_depth(a, b) > 0, 0.0, apart)


def _distance_from_corners(a: Boxes, b: Boxes) -> Tensor:
    """[...] m: distance from the rectangle `b` to the nearest corner of `a`."""
    nearest = torch.tensor(torch.inf, dtype=a.x.dtype)
    for ahead, left in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        along_a, across_a = ahead * a.half_length, left * a.half_width
        dx = a.x + along_a * a.cos - across_a * a.sin - b.x
        dy = a.y + along_a * a.sin + across_a * a.cos - b.y
        along_b = ((dx * b.cos + dy * b.sin).abs() - b.half_length).clamp(min=0)
        across_b = ((dy * b.cos - dx * b.sin).abs() - b.half_width).clamp(min=0)
        nearest = torch.minimum(nearest, torch.hypot(along_b, across_b))
    return nearest
