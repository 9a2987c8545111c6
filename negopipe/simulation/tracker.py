"""Tracker of the other vehicles: a Kalman filter with constant velocity.

A vehicle that is not seen for a moment is carried on, and what is seen is smoothed. Which sighting belongs to which
vehicle is known. Two filters per pair of vehicles, with the notation of Bar-Shalom, Li and Kirubarajan, "Estimation
with Applications to Tracking and Navigation" (2001):

    motion   along each of the world's axes the state (position, velocity), F = [[1, dt], [0, 1]], H = I. The process
             noise is a white acceleration, Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]] (section 6.2.2)
    heading  a random walk in the distance driven, F = H = 1: a vehicle at rest cannot turn

The measured velocity is the measured speed along the measured heading. Its error is taken as equal along both axes;
across the heading it is smaller below 10 m/s (with the errors of `perception=noisy`). So the axes are independent and
have one covariance.
"""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from negopipe.checks import Problem, check_times
from negopipe.schema import NonNegativeFloat, PositiveFloat, schema
from negopipe.simulation.geometry import wrap_angle
from negopipe.simulation.state import Estimate, Sightings, Tracks
from negopipe.tensors.tree import map_tensors, tree_where

MOST_STEPS = 2**31
"""Steps that no episode lasts."""

LEAST = torch.finfo(torch.float32).tiny
"""Smallest number by which is divided: a sensor without errors leaves a vehicle at rest without variance."""


@schema
class TrackerConfig:
    """`conf/perception/noisy.yaml` says what each value means."""

    forget_after_s: NonNegativeFloat
    accel_std_mps2: PositiveFloat
    curvature_std_1pm: PositiveFloat

    def check(self, dt_s: float) -> Iterator[Problem]:
        yield from check_times({"perception.tracker.forget_after_s": (self.forget_after_s,)}, dt_s)


class Tracker:
    """Tracks of every other vehicle by every vehicle, one control step at a time.

    variances: of the measured position (m2, along each axis), heading (rad2) and speed (m2/s2)
    """

    def __init__(
        self, config: TrackerConfig, dt_s: float, variances: tuple[float, float, float], lowest_speed_mps: float = 0.0
    ) -> None:
        self.config, self.dt_s, self.variances, self._lowest_speed = config, dt_s, variances, lowest_speed_mps
        self._forget_steps = round(min(config.forget_after_s / dt_s, MOST_STEPS))

    def start(self, first: Sightings, age_s: Tensor, n_steps: int) -> Tracks:
        """Tracks that begin with the sightings `first` (J = 1), taken `age_s` [E] ago.

        n_steps: J of the history. Before its start a track is as at its start
        """
        n_missed = torch.where(first.is_seen[:, 0], 0, self._forget_steps + 1)
        estimate = _where_tracked(first.is_seen[:, 0], self._measured(first))
        now = _as_tracked(estimate, first.is_seen[:, 0], age_s, self._lowest_speed)
        return Tracks(estimate, n_missed, map_tensors(lambda f: f.repeat(1, n_steps, *[1] * (f.dim() - 2)), now))

    def follow(self, tracks: Tracks, latest: Sightings, is_new: Tensor, age_s: Tensor) -> Tracks:
        """Tracks one control step later, with the sightings `latest` (J = 1), taken `age_s` [E] ago.

        is_new: [E] bool; where false, there is no sighting later than the one of the step before
        """
        is_seen, measured = latest.is_seen[:, 0], self._measured(latest)
        was_tracked = tracks.n_missed <= self._forget_steps
        predicted = predict(tracks.estimate, self.dt_s, self.config.accel_std_mps2, self.config.curvature_std_1pm)
        corrected = tree_where(was_tracked, update(predicted, measured), measured)
        n_missed = torch.where(is_seen, 0, (tracks.n_missed + 1).clamp(max=self._forget_steps + 1))
        estimate = _where_tracked(n_missed <= self._forget_steps, tree_where(is_seen, corrected, predicted))
        estimate = tree_where(is_new, estimate, tracks.estimate)
        n_missed = torch.where(is_new[:, None, None], n_missed, tracks.n_missed)
        now = _as_tracked(estimate, n_missed <= self._forget_steps, age_s, self._lowest_speed)
        return Tracks(estimate, n_missed, map_tensors(_append, now, tracks.history))

    def _measured(self, latest: Sightings) -> Estimate:
        """[E, V, O]: a sighting as an estimate, with the variances of the sensor."""
        position_variance, yaw_variance, speed_variance = self.variances
        x, y, yaw = latest.pose[:, 0].unbind(-1)
        speed = latest.speed[:, 0]
        variance = torch.stack([torch.full_like(x, each) for each in (position_variance, 0.0, speed_variance)], -1)
        return Estimate(
            position=torch.stack([x, y], -1),
            velocity=torch.stack([speed * torch.cos(yaw), speed * torch.sin(yaw)], -1),
            covariance=variance,
            yaw=yaw,
            yaw_variance=torch.full_like(x, yaw_variance),
        )


def predict(estimate: Estimate, dt_s: float, accel_std_mps2: float, curvature_std_1pm: float) -> Estimate:
    """Estimate [...] `dt_s` later: x = F x, P = F P F' + Q.

    accel_std_mps2: its square times `dt_s` is the power density q of the acceleration, so that a speed changes by
        accel_std_mps2 * dt_s (standard deviation) in a step
    curvature_std_1pm: a heading changes by that times the distance driven (standard deviation) in a step
    """
    power = accel_std_mps2**2 * dt_s
    p_xx, p_xv, p_vv = estimate.covariance.unbind(-1)
    covariance = [
        p_xx + 2 * dt_s * p_xv + dt_s**2 * p_vv + power * dt_s**3 / 3,
        p_xv + dt_s * p_vv + power * dt_s**2 / 2,
        p_vv + power * dt_s,
    ]
    driven_squared = estimate.velocity.square().sum(-1) * dt_s**2
    turned = estimate.yaw_variance + curvature_std_1pm**2 * driven_squared
    position = estimate.position + dt_s * estimate.velocity
    return replace(estimate, position=position, covariance=torch.stack(covariance, -1), yaw_variance=turned)


def update(predicted: Estimate, measured: Estimate) -> Estimate:
    """Estimate [...] after a measurement z of the whole state: x + K (z - x) with K = P (P + R)^-1, and P = K R.

    K R is the textbook's (I - K) P where H = I. It subtracts nothing, so that rounding leaves it positive.
    """
    p_xx, p_xv, p_vv = predicted.covariance.unbind(-1)
    r_xx, _, r_vv = measured.covariance.unbind(-1)
    s_xx, s_vv = p_xx + r_xx, p_vv + r_vv
    determinant = (s_xx * s_vv - p_xv**2).clamp(min=LEAST)
    k_xx, k_xv = (p_xx * s_vv - p_xv**2) / determinant, p_xv * r_xx / determinant
    k_vx, k_vv = p_xv * r_vv / determinant, (p_vv * s_xx - p_xv**2) / determinant
    off, off_speed = measured.position - predicted.position, measured.velocity - predicted.velocity
    gain = predicted.yaw_variance / (predicted.yaw_variance + measured.yaw_variance).clamp(min=LEAST)
    return Estimate(
        position=predicted.position + k_xx[..., None] * off + k_xv[..., None] * off_speed,
        velocity=predicted.velocity + k_vx[..., None] * off + k_vv[..., None] * off_speed,
        covariance=torch.stack([k_xx * r_xx, k_xv * r_vv, k_vv * r_vv], -1),
        yaw=wrap_angle(predicted.yaw + gain * wrap_angle(measured.yaw - predicted.yaw)),
        yaw_variance=gain * measured.yaw_variance,
    )


def no_tracks(like: Tensor) -> Tracks:
    """Empty tracks of the worlds of `like` [E, ...] float32, for worlds without a tracker."""
    n = len(like)
    pairs, steps = like.new_zeros(n, 0, 0), like.new_zeros(n, 0, 0, 0)
    estimate = Estimate(pairs[..., None], pairs[..., None], pairs[..., None], pairs, pairs)
    return Tracks(estimate, pairs.long(), Sightings(steps[..., None], steps, steps.bool()))


def _where_tracked(is_tracked: Tensor, estimate: Estimate) -> Estimate:
    return tree_where(is_tracked, estimate, map_tensors(torch.zeros_like, estimate))


def _as_tracked(estimate: Estimate, is_tracked: Tensor, age_s: Tensor, lowest_speed: float) -> Sightings:
    """The vehicles now (J = 1), by estimates [E, V, O] of `age_s` [E] ago: the speed is that along the heading."""
    position = estimate.position + age_s[:, None, None, None] * estimate.velocity
    cos, sin = torch.cos(estimate.yaw), torch.sin(estimate.yaw)
    speed = (estimate.velocity[..., 0] * cos + estimate.velocity[..., 1] * sin).clamp(min=lowest_speed)
    pose = torch.cat([position, estimate.yaw[..., None]], -1)
    return Sightings(pose[:, None], speed[:, None], is_tracked[:, None])


def _append(now: Tensor, history: Tensor) -> Tensor:
    return torch.cat([now, history[:, :-1]], 1)
