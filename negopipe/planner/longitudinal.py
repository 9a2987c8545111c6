"""Longitudinal candidates: keeping a speed (quartics) and stopping after a distance (quintics)."""

from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from negopipe.planner.polynomial import quartic, quintic, sampling_rows
from negopipe.schema import Fraction, NonNegativeFloat, PositiveFloat, schema
from negopipe.simulation.road import RouteState


@schema
class LongitudinalConfig:
    """The candidates, every speed with every keeping duration and every distance with every stopping duration.

    keep_fractions: target speeds as fractions of the vehicle's desired speed
    keep_durations_s: time to reach the target speed; afterwards it is held
    stop_distances_m: distances ahead at which the vehicle comes to rest
    stop_durations_s: time to come to rest
    settle_rate_hz: a braking vehicle plans from an acceleration of at least -settle_rate * speed, so that it
        comes to rest without overshooting into reverse
    """

    keep_fractions: Annotated[list[Fraction], Field(min_length=1)]
    keep_durations_s: Annotated[list[PositiveFloat], Field(min_length=1)]
    stop_distances_m: Annotated[list[NonNegativeFloat], Field(min_length=1)]
    stop_durations_s: Annotated[list[PositiveFloat], Field(min_length=1)]
    settle_rate_hz: PositiveFloat


class LongitudinalSamples(NamedTuple):
    """Candidates C sampled at T times; every field [N, C, T] float32, relative to the state planned from.

    travelled: m along the road since now
    speed: m/s; accel: m/s2; jerk: m/s3
    """

    travelled: Tensor
    speed: Tensor
    accel: Tensor
    jerk: Tensor


class LongitudinalCandidates:
    """All candidates are linear in (speed, acceleration, desired speed, 1): four matrices hold them."""

    def __init__(self, config: LongitudinalConfig, times: Tensor) -> None:
        self.config = config
        maps = [(duration, _keep(fraction, duration)) for duration in config.keep_durations_s
                for fraction in config.keep_fractions]  # fmt: skip
        maps += [(duration, _stop(distance, duration)) for duration in config.stop_durations_s
                 for distance in config.stop_distances_m]  # fmt: skip
        self.n_candidates = len(maps)
        self._basis = [
            torch.stack([sampling_rows(times, duration, order) @ linear for duration, linear in maps])
            .flatten(0, 1)
            .T.to(times.device, torch.float32)
            .contiguous()
            for order in range(4)
        ]  # per derivative [4, C * T]

    def sample(self, route: RouteState, desired_speed: Tensor) -> LongitudinalSamples:
        """Candidates of N vehicles: `route` fields [N], `desired_speed` [N] m/s."""
        accel = torch.maximum(route.s_ddot, -self.config.settle_rate_hz * route.s_dot)
        given = torch.stack([route.s_dot, accel, desired_speed, torch.ones_like(accel)], dim=-1)
        shape = (-1, self.n_candidates, self._basis[0].shape[1] // self.n_candidates)
        return LongitudinalSamples(*((given @ basis).reshape(shape) for basis in self._basis))


def _keep(fraction: float, duration: float) -> Tensor:
    """[6, 4] float64: (speed, accel, desired speed, 1) -> quartic that reaches fraction * desired speed."""
    boundary = torch.zeros(5, 4, dtype=torch.float64)  # rows p0 v0 a0 v1 a1
    boundary[1, 0] = boundary[2, 1] = 1
    boundary[3, 2] = fraction
    return quartic(duration) @ boundary


def _stop(distance: float, duration: float) -> Tensor:
    """[6, 4] float64: (speed, accel, desired speed, 1) -> quintic that rests after `distance`."""
    boundary = torch.zeros(6, 4, dtype=torch.float64)  # rows p0 v0 a0 p1 v1 a1
    boundary[1, 0] = boundary[2, 1] = 1
    boundary[3, 3] = distance
    return quintic(duration) @ boundary
