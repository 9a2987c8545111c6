"""Tasks: which vehicles start where, how fast, and in which driving style."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field, model_validator
from torch import Tensor

from negopipe.checks import Problem, check_horizons
from negopipe.errors import UserError
from negopipe.schema import (
    FileName,
    Interval,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    PositiveInterval,
    PositiveMetres,
    schema,
)
from negopipe.simulation.road import RoadConfig
from negopipe.simulation.state import EGO, Task


@schema
class VehicleConfig:
    """Footprint of every vehicle, m."""

    length_m: PositiveMetres
    width_m: PositiveMetres


Styles = Annotated[list[NonNegativeFloat], Field(min_length=1)]
"""Prediction horizons of a social vehicle's planner, s."""


@schema
class StyleSwitchConfig:
    """When a social vehicle changes its style, once per episode; of two causes the first to come counts.

    style_horizon_s: the styles switched to, each equally likely (the one it had may come again)
    at_s: uniform interval of the time in the episode; null = not by the clock
    stuck_s: uniform interval of the time at rest without a break (`World.rest_steps`); null = not for being stuck
    """

    style_horizon_s: Styles
    at_s: Interval | None
    stuck_s: Interval | None

    @model_validator(mode="after")
    def _has_a_cause(self) -> "StyleSwitchConfig":
        if self.at_s is None and self.stuck_s is None:
            raise ValueError("must have an interval for at_s or stuck_s, both are null")
        return self


@schema
class FamilyConfig:
    """A family of tasks: the social vehicle's start distances and styles.

    weight: share of the family among the tasks drawn, relative to the other families
    start_distance_m: uniform interval, of the first social vehicle to its mouth of the corridor
    gaps_m: intervals between whose ends no start distance is drawn, ascending; the rest stays uniform
    style_horizon_s: styles of the social vehicles, each equally likely
    style_switch: null = a vehicle keeps its style
    """

    weight: PositiveFloat
    start_distance_m: Interval
    gaps_m: list[Interval]
    style_horizon_s: Styles
    style_switch: StyleSwitchConfig | None

    @model_validator(mode="after")
    def _leaves_a_distance(self) -> "FamilyConfig":
        low, high = self.start_distance_m
        for gap in self.gaps_m:
            if gap[0] < low or gap[1] > high:
                raise ValueError(f"gaps_m must lie within start_distance_m = {[low, high]}, got {list(gap)}")
        for gap, following in pairwise(self.gaps_m):
            if gap[1] > following[0]:
                raise ValueError(f"gaps_m must be ascending and disjoint, got {list(following)} after {list(gap)}")
        if self.gaps_m and not self.pieces_m:
            got = ", ".join(str(list(gap)) for gap in self.gaps_m)
            raise ValueError(f"gaps_m must leave some of start_distance_m = {[low, high]}, got {got}")
        return self

    def horizons_s(self, key: str) -> dict[str, list[float]]:
        """Prediction horizons of the social vehicles, s, by the key of each where the family stands at `key`."""
        horizons_s = {f"{key}.style_horizon_s": self.style_horizon_s}
        if self.style_switch is not None:
            horizons_s[f"{key}.style_switch.style_horizon_s"] = self.style_switch.style_horizon_s
        return horizons_s

    @property
    def pieces_m(self) -> list[tuple[float, float]]:
        """What the gaps leave of the start distances: intervals that are longer than 0, ascending."""
        low, high = self.start_distance_m
        ends = [low, *(end for gap in self.gaps_m for end in gap), high]
        return [piece for piece in zip(ends[::2], ends[1::2], strict=True) if piece[0] < piece[1]]


Families = dict[FileName, FamilyConfig]
"""By name, which is part of the names of the report's files."""


@schema
class ScenarioConfig:
    """One scenario; `conf/scenario/narrow_lane.yaml` says what each value means."""

    dt_s: Annotated[PositiveFloat, Field(le=2)]  # a deadlock is told by a few seconds at rest
    episode_steps: PositiveInt
    n_social: PositiveInt
    social_spacing_m: PositiveMetres
    road: RoadConfig
    vehicle: VehicleConfig
    ego_start_distance_m: Interval
    start_speed_mps: Interval
    desired_speed_mps: PositiveInterval
    pairing: Literal["ego_behaviour", "literal"]
    families: Annotated[Families, Field(min_length=1)]

    def check(self, plan_s: float) -> Iterator[Problem]:
        """plan_s: length of a plan."""
        for name, family in self.families.items():
            yield from check_horizons(family.horizons_s(f"scenario.families.{name}"), self.dt_s, plan_s)


def pair_styles(families: Families, pairing: str) -> Families:
    """Settle whose behaviour `push` and `yield` name (docs/reading.md, "start positions").

    `ego_behaviour` leaves the families as configured; `literal` reads the paper's labels as the style of the
    social vehicle, which swaps the styles of the two families and their switches. Other families are not touched.
    """
    if pairing == "ego_behaviour" or not {"push", "yield"} <= families.keys():
        return families
    push, yield_ = families["push"], families["yield"]
    swapped = {
        "push": replace(push, style_horizon_s=yield_.style_horizon_s, style_switch=yield_.style_switch),
        "yield": replace(yield_, style_horizon_s=push.style_horizon_s, style_switch=push.style_switch),
    }
    return {**families, **swapped}


NEVER = (math.inf, math.inf)
"""An interval that nothing comes to."""


class _Tables(NamedTuple):
    """What F families draw from, by the index of the family.

    until: [F] float32, cumulative shares of the families
    distance, switch_time, patience: [F, 2] float32, intervals; m, s, s; (inf, inf) for never
    gaps: [F, G, 2] float32, m, inside `distance`, ascending; filled up with (inf, inf)
    styles, next_styles: [F, K] float32, s, filled up; n_styles, n_next_styles: [F], how many of them count
    """

    until: Tensor
    distance: Tensor
    gaps: Tensor
    switch_time: Tensor
    patience: Tensor
    styles: Tensor
    n_styles: Tensor
    next_styles: Tensor
    n_next_styles: Tensor


class TaskSampler:
    """Draws tasks from a mixture of families with a generator of its own.

    Every draw takes the same number of random values whatever it draws, so a sampler's stream can be compared
    between configurations.
    """

    def __init__(self, scenario: ScenarioConfig, families: Families, generator: torch.Generator) -> None:
        if not families:
            raise UserError("families must name at least one task family, got none")
        self.scenario = scenario
        self.families = pair_styles(families, scenario.pairing)
        self.generator = generator
        self._tables = _tabulate(list(self.families.values()), generator.device)

    def draw(self, n: int) -> Task:
        """`n` tasks, on the generator's device."""
        scenario, tables, n_social = self.scenario, self._tables, self.scenario.n_social
        n_vehicles = 1 + n_social
        widths = [1, 1, 1, 1, n_vehicles, n_vehicles, n_social, n_social, n_social, n_social]
        shares = torch.rand(n, sum(widths), generator=self.generator, device=self.generator.device)
        which, noise, ego, first, start, desired, style, next_style, switch, patience = shares.split(widths, dim=1)
        family = torch.searchsorted(tables.until, which[:, 0].contiguous(), right=True).clamp(max=len(tables.until) - 1)
        behind = torch.arange(n_social, device=family.device) * scenario.social_spacing_m
        social = _outside(tables.gaps[family], tables.distance[family], first) + behind
        direction = -torch.ones(n, n_vehicles, device=family.device)
        direction[:, EGO] = 1
        return Task(
            start_distance=torch.cat([_between(scenario.ego_start_distance_m, ego), social], dim=1),
            start_speed=_between(scenario.start_speed_mps, start),
            desired_speed=_between(scenario.desired_speed_mps, desired),
            style_horizon=_with_ego(torch.nan, _one_of(tables.styles, tables.n_styles, family, style)),
            next_style_horizon=_with_ego(
                torch.nan, _one_of(tables.next_styles, tables.n_next_styles, family, next_style)
            ),
            switch_time=_with_ego(torch.inf, _between_each(tables.switch_time[family], switch)),
            patience=_with_ego(torch.inf, _between_each(tables.patience[family], patience)),
            direction=direction,
            noise_seed=(noise[:, 0] * 2**24).long(),  # 24 bits is what a random float32 has
            family=family,
        )


def _tabulate(families: list[FamilyConfig], device: torch.device) -> _Tables:
    switches = [family.style_switch for family in families]
    pieces = [family.pieces_m or [family.start_distance_m] for family in families]
    weights = torch.tensor([family.weight for family in families], dtype=torch.float64)
    styles, n_styles = _filled_up([family.style_horizon_s for family in families])
    next_styles, n_next_styles = _filled_up([s.style_horizon_s if s else [math.nan] for s in switches])
    tables = _Tables(
        until=(weights.cumsum(0) / weights.sum()).float(),
        distance=torch.tensor([(each[0][0], each[-1][1]) for each in pieces]),
        gaps=_gaps_between(pieces),
        switch_time=torch.tensor([(s and s.at_s) or NEVER for s in switches]),
        patience=torch.tensor([(s and s.stuck_s) or NEVER for s in switches]),
        styles=styles,
        n_styles=n_styles,
        next_styles=next_styles,
        n_next_styles=n_next_styles,
    )
    return _Tables(*(field.to(device) for field in tables))


def _gaps_between(pieces: list[list[tuple[float, float]]]) -> Tensor:
    """[F, G, 2] float32. A gap at an end of the start distances only moves that end, so none of it lies between."""
    gaps = [[(before[1], behind[0]) for before, behind in pairwise(each)] for each in pieces]
    longest = max(map(len, gaps))
    filled = [each + [NEVER] * (longest - len(each)) for each in gaps]
    return torch.tensor(filled).reshape(len(gaps), longest, 2)


def _filled_up(rows: list[list[float]]) -> tuple[Tensor, Tensor]:
    """[F, K] float32 and the lengths [F] of the rows."""
    longest = max(map(len, rows))
    filled = [row + [math.nan] * (longest - len(row)) for row in rows]
    return torch.tensor(filled), torch.tensor([len(row) for row in rows])


def _one_of(values: Tensor, n_values: Tensor, family: Tensor, share: Tensor) -> Tensor:
    """[n, V] float32: one of the family's values per vehicle."""
    last = (n_values - 1)[family, None]
    index = (share * n_values[family, None]).long().minimum(last)
    return values[family].gather(1, index)


def _between(interval: tuple[float, float], share: Tensor) -> Tensor:
    low, high = interval
    return low + (high - low) * share


def _between_each(intervals: Tensor, share: Tensor) -> Tensor:
    """[n, V] float32 from the rows' intervals [n, 2]; one at infinity gives infinity."""
    low, high = intervals[:, :1], intervals[:, 1:]
    return torch.where(low.isinf(), low, low + (high - low) * share)


def _outside(gaps: Tensor, intervals: Tensor, share: Tensor) -> Tensor:
    """[n, V] float32 from the rows' intervals [n, 2] without their gaps [n, G, 2].

    What is drawn of the interval less the gaps' lengths moves up by every gap that it has reached. The bounds
    take what float32 rounds: into a gap, or past the interval's end.
    """
    low, high = intervals[:, :1], intervals[:, 1:]
    length = high - low - gaps.diff(dim=-1).nan_to_num(nan=0.0).sum(dim=1)  # nan: inf - inf, of those filled up
    distance = low + length * share
    for gap in gaps.unbind(dim=1):
        start, end = gap.split(1, dim=1)
        distance = torch.where(distance >= start, (distance + (end - start)).maximum(end), distance)
    return distance.clamp(low, high)


def _with_ego(ego: float, social: Tensor) -> Tensor:
    """[n, 1 + S]: `ego` in the ego's column, then the social vehicles'."""
    return torch.cat([social.new_full((len(social), 1), ego), social], dim=1)
