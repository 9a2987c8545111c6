"""Stops with one level of deceleration, which stay candidates when they are planned anew.

The acceleration changes with one jerk to the level, is held there, and returns to 0 at rest. What is left of such a
stop after a while is the stop with the same level, jerk and place of rest from the state reached then. So a stop that
was chosen is among the candidates of every later decision. A polynomial with a fixed duration is not, because its
duration starts anew with every decision.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from negopipe.schema import NonNegativeMetres, PositiveFloat, Real, schema
from negopipe.simulation.road import RouteState

FARTHEST_M = 100.0
"""Largest distance to a place of rest, m."""
LEAST = 1e-6
"""Smallest speed, deceleration, distance or duration that is divided by."""


@schema
class StopConfig:
    """Stops with one level of deceleration each.

    decels_mps2: levels
    positions_m: places s at which the vehicle comes to rest (0 = the mouth of the corridor)
    margins_m: distances before the first blocked place, at which the vehicle comes to rest
    jerk_mps3: rate at which the acceleration changes
    """

    decels_mps2: list[PositiveFloat]
    positions_m: list[Real]
    margins_m: list[NonNegativeMetres]
    jerk_mps3: PositiveFloat

    @property
    def n_candidates(self) -> int:
        return len(self.decels_mps2) + len(self.positions_m) + len(self.margins_m)


@schema
class BrakingConfig:
    """Stops within the limits of comfort, and harder ones that cost more.

    decel_max_mps2: largest deceleration of a hard stop
    room_m: drivable distance ahead of the place of rest, so that the vehicle can leave it; less costs as slack does
    slack_m: distance by which a stop may come closer to another vehicle than the clearances ask
    standing_m: distance to rest within which a vehicle may stop wherever it is; null = not even one at rest
    """

    comfortable: StopConfig
    hard: StopConfig
    decel_max_mps2: PositiveFloat
    room_m: NonNegativeMetres
    slack_m: NonNegativeMetres
    standing_m: NonNegativeMetres | None

    @property
    def n_candidates(self) -> int:
        return self.comfortable.n_candidates + self.hard.n_candidates


class BrakingSamples(NamedTuple):
    """Stops B of N vehicles.

    travelled, speed: [B, T, N] m and m/s, along the road since now
    accel: [B, N] m/s2, at the first of the times
    hardest: [B, N] m/s2, largest deceleration from the first of the times on
    jerk_square: [B, N] m2/s6, mean over the times
    """

    travelled: Tensor
    speed: Tensor
    accel: Tensor
    hardest: Tensor
    jerk_square: Tensor


class _Phases(NamedTuple):
    """Phases of a stop, fields [B, N]: the acceleration changes to `-level`, is held, and returns to 0.

    level: m/s2
    jerk, last_jerk: m/s3, of the first and of the last phase
    first_s, held_s, last_s: durations
    """

    level: Tensor
    jerk: Tensor
    last_jerk: Tensor
    first_s: Tensor
    held_s: Tensor
    last_s: Tensor


class BrakingCandidates:
    """Stops from the present state. A place of rest is met exactly where the jerk suffices, else the stop is longer."""

    def __init__(self, config: BrakingConfig, times: Tensor) -> None:
        groups = [group for group in (config.comfortable, config.hard) if group.n_candidates]
        self.n_candidates, self.n_comfortable = config.n_candidates, config.comfortable.n_candidates
        self._times = times[:, None]  # [T, 1]
        self._groups = [tuple(_column(values, times) for values in _lists(group)) for group in groups]

    def sample(self, route: RouteState, free_m: Tensor) -> BrakingSamples:
        """Stops of N vehicles, the comfortable ones first.

        route: fields [N]; free_m: [N] m, distance to the first blocked place
        """
        speed, accel = route.s_dot, route.s_ddot
        levels, jerks = [], []
        for decels, positions, margins, jerk in self._groups:
            places = torch.cat([positions - route.s, free_m - margins]).clamp(0.0, FARTHEST_M)
            levels += [decels.expand(-1, len(speed)), level_to_rest(speed, accel, places, jerk)]
            jerks.append(jerk.expand(len(decels) + len(places), 1))
        return self._follow(speed, accel, _phases(speed, accel, torch.cat(levels), torch.cat(jerks)))

    def _follow(self, speed: Tensor, accel: Tensor, phases: _Phases) -> BrakingSamples:
        level, jerk, last_jerk, first_s, held_s, last_s = (field[:, None] for field in phases)  # [B, 1, N]
        in_first = torch.minimum(self._times, first_s)
        in_held = torch.minimum((self._times - first_s).clamp(min=0), held_s)
        in_last = torch.minimum((self._times - first_s - held_s).clamp(min=0), last_s)
        held_from = speed + first_s * (accel + first_s * jerk / 2)
        last_from = held_from - held_s * level
        travelled = in_first * (speed + in_first * (accel / 2 + in_first * jerk / 6))
        travelled = travelled + in_held * (held_from - in_held * level / 2)
        travelled = travelled + in_last * (last_from + in_last * (in_last * last_jerk / 6 - level / 2))
        now = speed + in_first * (accel + in_first * jerk / 2) - in_held * level
        now = now + in_last * (in_last * last_jerk / 2 - level)
        jerk_square = (phases.jerk**2 * phases.first_s + phases.last_jerk**2 * phases.last_s) / self._times[-1]
        after = self._first_accel(accel, phases)
        return BrakingSamples(travelled, now, after, torch.maximum(phases.level, -after), jerk_square)

    def _first_accel(self, accel: Tensor, phases: _Phases) -> Tensor:
        """[B, N] m/s2: acceleration at the first of the times."""
        time = self._times[0]
        easing = phases.last_jerk * (time - phases.first_s - phases.held_s).clamp(min=0)
        later = (easing - phases.level).clamp(max=0)
        return torch.where(time < phases.first_s, accel + phases.jerk * time, later)


def _lists(group: StopConfig) -> tuple[list[float], ...]:
    return group.decels_mps2, group.positions_m, group.margins_m, [group.jerk_mps3]


def _column(values: list[float], like: Tensor) -> Tensor:
    return torch.tensor(values, device=like.device)[:, None]


def level_to_rest(speed: Tensor, accel: Tensor, distance: Tensor, jerk: Tensor) -> Tensor:
    """Level (m/s2) with which a vehicle comes to rest after `distance` (m); all broadcast.

    The distance is `k + g w b / (2 j) + w^2 / (2 b)` for the level b and the jerk j, where g = 1 if the vehicle has to
    brake harder than now and g = -1 else. It is a quadratic equation in b. Where the jerk does not suffice, the level
    is larger than any that is reached.
    """
    now = (-accel).clamp(min=LEAST)
    kept = speed**2 / (2 * now) + now**3 / (24 * jerk**2)  # distance to rest if the present deceleration is held
    sign = torch.where((accel >= 0) | (distance < kept), 1.0, -1.0)
    w = (speed + sign * accel**2 / (2 * jerk)).clamp(min=LEAST)
    rest = distance - accel * (sign * speed / jerk + accel**2 / (3 * jerk**2))
    root = torch.sqrt((rest**2 - sign * w**3 / jerk).clamp(min=0))
    return w**2 / (rest + root).clamp(min=LEAST)


def _phases(speed: Tensor, accel: Tensor, level: Tensor, jerk: Tensor) -> _Phases:
    """speed, accel: [N]; level: [B, N], at most; jerk: [B, 1]"""
    now = -accel
    is_late = (now > 0) & (speed <= now**2 / (2 * jerk))  # it would drive backwards with this jerk: it eases faster
    level = torch.minimum(level, torch.sqrt(jerk * speed + now**2 / 2)).clamp(min=LEAST)
    level = torch.where(is_late, now, level)
    first_s = (level - now).abs() / jerk
    first_jerk = torch.where(level < now, jerk, -jerk)
    held_from = speed + first_s * (accel + first_s * first_jerk / 2)
    last_s = torch.where(is_late, 2 * speed / level, level / jerk)
    held_s = ((held_from - last_s * level / 2) / level).clamp(min=0)
    return _Phases(level, first_jerk, level / last_s.clamp(min=LEAST), first_s, held_s, last_s)
