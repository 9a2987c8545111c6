"""Longitudinal candidates: quartics that keep a speed, quintics that stop after a distance or at a place."""

from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from negopipe.planner.polynomial import derivative_row, quartic, quintic, sampling_rows
from negopipe.schema import Fraction, NonNegativeFloat, PositiveFloat, Real, schema
from negopipe.simulation.road import RouteState


@schema
class LongitudinalConfig:
    """Longitudinal candidates: every speed with every keeping duration, every stop with every stopping duration.

    keep_fractions: target speeds as fractions of the vehicle's desired speed
    keep_durations_s: times to reach the target speed, which is then kept
    stop_distances_m: distances ahead at which the vehicle comes to rest
    stop_positions_m: places s at which it comes to rest (0 = the mouth of the corridor)
    stop_durations_s: times to come to rest
    settle_rate_hz: a braking vehicle plans from an acceleration of at least -settle_rate * speed, so that it
        comes to rest without overshooting into reverse
    """

    keep_fractions: Annotated[list[Fraction], Field(min_length=1)]
    keep_durations_s: Annotated[list[PositiveFloat], Field(min_length=1)]
    stop_distances_m: list[NonNegativeFloat]
    stop_positions_m: list[Real]
    stop_durations_s: Annotated[list[PositiveFloat], Field(min_length=1)]
    settle_rate_hz: PositiveFloat

    @property
    def n_candidates(self) -> int:
        n_stops = len(self.stop_distances_m) + len(self.stop_positions_m)
        return len(self.keep_fractions) * len(self.keep_durations_s) + n_stops * len(self.stop_durations_s)


class LongitudinalSamples(NamedTuple):
    """Candidates C sampled at T times; every field [C, T, N] float32, relative to the state planned from.

    travelled: m along the road since now
    speed: m/s; accel: m/s2; jerk: m/s3
    jerk_now: [C, N] m/s3, at the state planned from, before the first of the times
    """

    travelled: Tensor
    speed: Tensor
    accel: Tensor
    jerk: Tensor
    jerk_now: Tensor


class LongitudinalCandidates:
    """Longitudinal candidates, linear in (speed, acceleration, target), so that their sampling matrices are constant.

    The target is the speed to reach or the distance to stop after.
    """

    def __init__(self, config: LongitudinalConfig, times: Tensor) -> None:
        self.config = config
        device = times.device
        keep = [(fraction, duration) for duration in config.keep_durations_s for fraction in config.keep_fractions]
        n_stops = len(config.stop_distances_m) + len(config.stop_positions_m)
        maps = [(duration, _keep(duration)) for _, duration in keep]
        maps += [(duration, _stop(duration)) for duration in config.stop_durations_s for _ in range(n_stops)]
        self.n_candidates = config.n_candidates
        self._basis = [
            torch.stack([sampling_rows(times, duration, order) @ linear for duration, linear in maps])
            .to(device, torch.float32)[..., None]
            .unbind(2)
            for order in range(4)
        ]  # per derivative three of [C, T, 1]
        third = torch.stack([derivative_row(0.0, 3) @ linear for _, linear in maps])
        self._basis_now = third.to(device, torch.float32)[..., None].unbind(1)  # three of [C, 1]
        self._fractions = torch.tensor([fraction for fraction, _ in keep], device=device)[:, None]
        self._stop_distances = torch.tensor(config.stop_distances_m, device=device)[:, None]
        self._stop_positions = torch.tensor(config.stop_positions_m, device=device)[:, None]

    def sample(self, route: RouteState, desired_speed: Tensor) -> LongitudinalSamples:
        """Candidates of N vehicles: `route` fields [N], `desired_speed` [N] m/s."""
        accel = torch.maximum(route.s_ddot, -self.config.settle_rate_hz * route.s_dot)
        stops = torch.cat([self._stop_distances.expand(-1, len(accel)), self._stop_positions - route.s])
        n_repeats = len(self.config.stop_durations_s)
        target = torch.cat([self._fractions * desired_speed, *[stops] * n_repeats])  # [C, N]
        jerk_now = _weighted(self._basis_now, route.s_dot, accel, target)
        travelled, speed, accels, jerk = (
            _weighted(basis, route.s_dot, accel, target[:, None]) for basis in self._basis
        )
        return LongitudinalSamples(travelled, speed, accels, jerk, jerk_now)


def _weighted(basis: tuple[Tensor, ...], speed: Tensor, accel: Tensor, target: Tensor) -> Tensor:
    return basis[0] * speed + basis[1] * accel + basis[2] * target


def _keep(duration: float) -> Tensor:
    """[6, 3] float64: (speed, acceleration, speed to reach) -> quartic."""
    boundary = torch.zeros(5, 3, dtype=torch.float64)  # rows p0 v0 a0 v1 a1
    boundary[1, 0] = boundary[2, 1] = boundary[3, 2] = 1
    return quartic(duration) @ boundary


def _stop(duration: float) -> Tensor:
    """[6, 3] float64: (speed, acceleration, distance to rest after) -> quintic."""
    boundary = torch.zeros(6, 3, dtype=torch.float64)  # rows p0 v0 a0 p1 v1 a1
    boundary[1, 0] = boundary[2, 1] = boundary[3, 2] = 1
    return quintic(duration) @ boundary
