"""Tasks: the start positions, speeds and driving styles of an episode, and the distributions they are drawn from."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field, model_validator
from torch import Tensor

from negopipe.checks import Foresight, Problem, check_horizons
from negopipe.errors import UserError
from negopipe.schema import (
    FileName,
    Fraction,
    Horizon,
    Interval,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    PositiveInterval,
    PositiveMetres,
    SizeRange,
    schema,
)
from negopipe.simulation.geometry import Size
from negopipe.simulation.map_config import MapConfig, read_map
from negopipe.simulation.road_config import RoadConfig, StreetsConfig
from negopipe.simulation.sizes import Sizes
from negopipe.simulation.state import EGO, Casting, Task
from negopipe.simulation.task_values import between, between_each, one_of, outside, queue, with_ego, without_absent
from negopipe.simulation.vehicle_kinds import VehicleKinds, bounds, draw_kinds


@schema
class VehicleConfig:
    """Footprint of the ego, and of every vehicle without a kind, m."""

    length_m: PositiveMetres
    width_m: PositiveMetres

    def is_within(self, other: "VehicleConfig") -> bool:
        return self.length_m <= other.length_m and self.width_m <= other.width_m


Styles = Annotated[list[Horizon], Field(min_length=1)]
"""Prediction horizons of a social vehicle's planner, s."""


@schema
class StyleSwitchConfig:
    """Change of a social vehicle's style, once per episode, at the earlier of two causes.

    style_horizon_s: the new styles, each equally likely (the old one may be among them)
    at_s: uniform interval of the time in the episode; null = time is no cause
    stuck_s: uniform interval of the time at rest without a break (`World.rest_steps`); null = rest is no cause
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
    """A family of tasks: the start distances and styles of the social vehicles.

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
        """The start distances without the gaps: intervals that are longer than 0, ascending, m."""
        low, high = self.start_distance_m
        ends = [low, *(end for gap in self.gaps_m for end in gap), high]
        return [piece for piece in zip(ends[::2], ends[1::2], strict=True) if piece[0] < piece[1]]


Families = dict[FileName, FamilyConfig]
"""Families by name; the name is part of file names of the report."""


@schema
class ScenarioConfig:
    """One scenario; `conf/scenario/narrow_lane.yaml` says what each value means."""

    dt_s: Annotated[PositiveFloat, Field(le=2)]  # a deadlock is told by a few seconds at rest
    episode_steps: PositiveInt
    n_social: PositiveInt
    n_followers: NonNegativeInt
    absent_queue_share: Fraction
    social_spacing_m: SizeRange
    road: RoadConfig
    streets: StreetsConfig
    map: MapConfig | None
    vehicle: VehicleConfig
    kinds: VehicleKinds
    ego_start_distance_m: Interval
    start_speed_mps: Interval
    desired_speed_mps: PositiveInterval
    pairing: Literal["ego_behaviour", "literal"]
    families: Annotated[Families, Field(min_length=1)]

    @property
    def has_many_streets(self) -> bool:
        """Whether streets are drawn; a map has one."""
        return self.map is None and self.road.varies

    @property
    def training_streets(self) -> range:
        """Numbers of the streets that training draws tasks on."""
        return range(1, 1 + self.streets.n_training) if self.has_many_streets else range(1, 2)

    @property
    def held_out_streets(self) -> range:
        """Numbers of the streets that everything else draws tasks on."""
        if not self.has_many_streets:
            return range(1, 2)
        first = 1 + self.streets.n_training
        return range(first, first + self.streets.n_held_out)

    @property
    def most_parked(self) -> int:
        """Upper bound on the parked cars of a street."""
        if self.map is not None:
            return len(read_map(self.map).parked)
        road = self.road
        counts = (road.n_parked_per_side, road.n_corridors, *(bay.n_parked for bay in road.bays))
        n_per_side, n_corridors, *in_bays = (max(n) if isinstance(n, tuple) else n for n in counts)
        return 2 * n_per_side * n_corridors + sum(in_bays)

    @property
    def n_others(self) -> int:
        """Social vehicles: those that come towards the ego, then those behind it."""
        return self.n_social + self.n_followers

    @property
    def n_vehicles(self) -> int:
        return 1 + self.n_others

    @property
    def queue_m(self) -> tuple[float, float]:
        """Distance of the last vehicle behind the ego to the ego, and of the last oncoming one to the first."""
        spacing_m = bounds(self.social_spacing_m)[1]
        return self.n_followers * spacing_m, (self.n_social - 1) * spacing_m

    @property
    def largest_of_kinds(self) -> dict[str, VehicleConfig]:
        """Upper bounds of the footprints of each kind."""
        return {
            name: VehicleConfig(length_m=bounds(kind.length_m)[1], width_m=bounds(kind.width_m)[1])
            for name, kind in self.kinds.items()
        }

    @property
    def sizes(self) -> Sizes:
        """Sizes of the ego and of all kinds."""
        ego = Size(self.vehicle.length_m, self.vehicle.width_m)
        lengths = [ego.length, *(end for kind in self.kinds.values() for end in bounds(kind.length_m))]
        widths = [ego.width, *(end for kind in self.kinds.values() for end in bounds(kind.width_m))]
        return Sizes(ego, Size(min(lengths), min(widths)), Size(max(lengths), max(widths)))

    def check(self, foresight: Foresight) -> Iterator[Problem]:
        """foresight: of the planner."""
        for name, family in self.families.items():
            yield from check_horizons(family.horizons_s(f"scenario.families.{name}"), self.dt_s, foresight)


def pair_styles(families: Families, pairing: str) -> Families:
    """The families under one of two readings of the labels `push` and `yield` (docs/reading.md, "start positions").

    `ego_behaviour` leaves the families as configured. `literal` reads the paper's labels as the style of the social
    vehicle, which swaps the styles and the switches of these two families. Other families stay as they are.
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
"""Interval of an event that never happens."""


class _Tables(NamedTuple):
    """Distributions of F families, by the index of the family.

    until: [F] float32, cumulative shares of the families
    distance, switch_time, patience: [F, 2] float32, intervals; m, s, s; (inf, inf) for never
    gaps: [F, G, 2] float32, m, inside `distance`, ascending; padded with (inf, inf)
    styles, next_styles: [F, K] float32, s, padded with NaN; n_styles, n_next_styles: [F], their numbers
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
    """Sampler of tasks from a mixture of families, with a generator of its own.

    Every task takes the same number of random values, so streams of different configurations can be compared.

    assign: gives the vehicles of drawn tasks their drivers, `agents.population.Cast.assign`; None = the planner drives
        all of them, in the styles of the families
    streets: numbers of the streets on which tasks are drawn; None = those that are held out
    street_weights: [len(streets)], how likely each is; None = equally
    """

    def __init__(
        self,
        scenario: ScenarioConfig,
        families: Families,
        generator: torch.Generator,
        assign: Callable[[Task], Task] | None = None,
        streets: range | None = None,
    ) -> None:
        if not families:
            raise UserError("families must name at least one task family, got none")
        self.scenario = scenario
        self.families = pair_styles(families, scenario.pairing)
        self.generator = generator
        self.streets = scenario.held_out_streets if streets is None else streets
        self.street_weights: Tensor | None = None
        self._assign = assign
        self._tables = _tabulate(list(self.families.values()), generator.device)

    def draw(self, n: int) -> Task:
        """Draw `n` tasks, on the generator's device."""
        return self._tasks(*self._random(n, self.generator))

    def expect(self, n: int) -> None:
        """Nothing to prepare: all worlds that draw from this stream are of one process."""

    def draw_for(self, worlds: Tensor) -> Task:
        """Draw the next tasks of `worlds` [n] int64 from the one stream of all worlds."""
        return self.draw(len(worlds))

    def draw_each(self, generators: Sequence[torch.Generator]) -> Task:
        """Draw one task with each of the generators, the one that a sampler with that generator draws."""
        parts = [self._random(1, generator) for generator in generators]
        shares, streets = zip(*parts, strict=True)
        return self._tasks(torch.cat(shares), torch.cat(streets))

    def get_state(self) -> Tensor:
        """State of the generator, uint8."""
        return self.generator.get_state()

    def set_state(self, state: Tensor) -> None:
        """Restore what `get_state` returned."""
        self.generator.set_state(state)

    def _random(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """All random values of `n` tasks: uniform numbers [n, K] and streets [n]."""
        shares = torch.rand(n, sum(self._widths), generator=generator, device=generator.device)
        return shares, self._draw_streets(n, generator)

    @property
    def _widths(self) -> list[int]:
        """Numbers of uniform values per task for each of its quantities."""
        n_vehicles, n_others = self.scenario.n_vehicles, self.scenario.n_others
        return [1, 1, 1, 1, n_vehicles, n_vehicles, n_others, n_others, n_others, n_others]

    def _tasks(self, shares: Tensor, streets: Tensor) -> Task:
        """The tasks that follow from random values."""
        scenario, tables, n_vehicles = self.scenario, self._tables, self.scenario.n_vehicles
        which, noise, ego, first, start, desired, style, next_style, switch, patience = shares.split(
            self._widths, dim=1
        )
        family = torch.searchsorted(tables.until, which[:, 0].contiguous(), right=True).clamp(max=len(tables.until) - 1)
        ego = between(scenario.ego_start_distance_m, ego)
        noise_seed = (noise[:, 0] * 2**24).long()  # 24 bits is what a random float32 has
        oncoming, behind_ego = (
            queue(scenario.social_spacing_m, noise_seed, n, channel)
            for channel, n in enumerate((scenario.n_social, 1 + scenario.n_followers))
        )
        social = outside(tables.gaps[family], tables.distance[family], first) + oncoming
        followers = ego + behind_ego[:, 1:]
        distance = without_absent(
            torch.cat([ego, social, followers], dim=1),
            *(noise_seed, scenario.absent_queue_share, scenario.n_social, scenario.n_followers),
        )
        direction = -streets[:, None].expand(-1, n_vehicles).contiguous()
        direction[:, [EGO, *range(1 + scenario.n_social, n_vehicles)]] *= -1
        task = Task(
            start_distance=distance,
            start_speed=between(scenario.start_speed_mps, start),
            desired_speed=between(scenario.desired_speed_mps, desired),
            style_horizon=with_ego(torch.nan, one_of(tables.styles, tables.n_styles, family, style)),
            next_style_horizon=with_ego(
                torch.nan, one_of(tables.next_styles, tables.n_next_styles, family, next_style)
            ),
            switch_time=with_ego(torch.inf, between_each(tables.switch_time[family], switch)),
            patience=with_ego(torch.inf, between_each(tables.patience[family], patience)),
            direction=direction,
            noise_seed=noise_seed,
            family=family,
            length=torch.full_like(direction, scenario.vehicle.length_m),
            width=torch.full_like(direction, scenario.vehicle.width_m),
            casting=Casting.of_nobody(direction),
        )
        task = draw_kinds(scenario.kinds, task)
        return task if self._assign is None else self._assign(task)

    def _draw_streets(self, n: int, generator: torch.Generator) -> Tensor:
        """[n] float32: numbers of streets; of one street no random value is drawn."""
        first, device = self.streets.start, generator.device
        if len(self.streets) == 1:
            return torch.full((n,), float(first), device=device)
        if self.street_weights is not None:
            return first + torch.multinomial(self.street_weights, n, True, generator=generator).float()
        return first + torch.randint(len(self.streets), (n,), generator=generator, device=device).float()


def _tabulate(families: list[FamilyConfig], device: torch.device) -> _Tables:
    switches = [family.style_switch for family in families]
    pieces = [family.pieces_m or [family.start_distance_m] for family in families]
    weights = torch.tensor([family.weight for family in families], dtype=torch.float64)
    styles, n_styles = _padded([family.style_horizon_s for family in families])
    next_styles, n_next_styles = _padded([s.style_horizon_s if s else [math.nan] for s in switches])
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
    """[F, G, 2] float32, m: gaps between the pieces of each family; a gap at an end of the interval is none of them."""
    gaps = [[(before[1], behind[0]) for before, behind in pairwise(each)] for each in pieces]
    longest = max(map(len, gaps))
    filled = [each + [NEVER] * (longest - len(each)) for each in gaps]
    return torch.tensor(filled).reshape(len(gaps), longest, 2)


def _padded(rows: list[list[float]]) -> tuple[Tensor, Tensor]:
    """Rows padded with NaN [F, K] float32, and their lengths [F]."""
    longest = max(map(len, rows))
    filled = [row + [math.nan] * (longest - len(row)) for row in rows]
    return torch.tensor(filled), torch.tensor([len(row) for row in rows])
