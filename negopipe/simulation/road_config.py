"""Configuration of a road: the sizes of its street, or intervals from which the sizes of many streets are drawn."""

from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

from negopipe.errors import UserError
from negopipe.schema import (
    CountRange,
    DistanceRange,
    FractionRange,
    NonNegativeMetres,
    PositiveFloat,
    PositiveInt,
    RealRange,
    Seed,
    SizeRange,
    schema,
)
from negopipe.simulation.bays import Bay, BaySide, check_bays
from negopipe.simulation.reference_line import Bend, check_bends
from negopipe.simulation.road_width import WidthChange, check_width_changes, width_at

ParkedSides = Literal["both", "left", "right", "alternating"]

LISTS: dict[str, type] = {"bends": Bend, "width_changes": WidthChange, "bays": Bay}
"""Fields of a road that are lists, each of whose items has sizes of its own, and what a street has of them."""

N_TRIES = 1000
"""Draws of a street until one fits."""


def _is_a_turn(angle_deg: Any) -> Any:
    for angle in angle_deg if isinstance(angle_deg, tuple) else (angle_deg,):
        if not -180 < angle < 180:
            raise ValueError(f"must be between -180 and 180, got {angle:g}")
    return angle_deg


@schema
class BendConfig:
    """A bend: the heading turns by `angle_deg` along the jerk-optimal step, so the curvature starts and ends at 0.

    start_m: arc length from the corridor's middle at which the bend begins
    length_m: arc length over which it turns
    angle_deg: how far it turns, positive to the left; the sharpest curvature is 15/8 of angle / length
    """

    start_m: RealRange
    length_m: SizeRange
    angle_deg: Annotated[RealRange, AfterValidator(_is_a_turn)]


@schema
class WidthChangeConfig:
    """A change of the road's width, the same at both kerbs, along the jerk-optimal step.

    start_m: arc length from the corridor's middle at which the change begins
    length_m: arc length over which the width changes
    width_m: distance from kerb to kerb behind it, until the next change
    """

    start_m: RealRange
    length_m: SizeRange
    width_m: SizeRange


@schema
class BayConfig:
    """A row of cars parked beside the road, behind its kerb, of the road's `parked_car_length_m` and `_width_m`.

    side: of the road, seen along the ego's way
    start_m: arc length from the corridor's middle at which it begins
    length_m: arc length from the near end of its first car to the far end of its last one
    kerb_gap_m: distance from the kerb to the cars
    is_across: whether the cars stand across the road
    n_parked: cars, evenly spaced
    """

    side: BaySide
    start_m: RealRange
    length_m: SizeRange
    kerb_gap_m: DistanceRange
    is_across: bool
    n_parked: CountRange


@dataclass(frozen=True)
class StreetConfig:
    """Sizes of one street in metres; `conf/scenario/narrow_lane.yaml` says what each value means.

    parked_seed: of the irregular places of the parked cars
    """

    bends: tuple[Bend, ...]
    width_m: float
    width_changes: tuple[WidthChange, ...]
    bays: tuple[Bay, ...]
    lane_offset_m: float
    corridor_length_m: float
    corridor_gap_m: float
    n_corridors: int
    between_corridors_m: float
    parked_sides: ParkedSides
    parked_car_length_m: float
    parked_car_width_m: float
    n_parked_per_side: int
    parked_empty_share: float
    parked_irregularity: float
    swerve_length_m: float
    swerve_margin_m: float
    target_distance_m: float
    parked_seed: int = 0

    def __post_init__(self) -> None:
        """Raise ValueError unless everything fits into the street."""
        needed, narrowest = self._needed_m, min(self.widths_m)
        if needed > narrowest + 1e-6:
            raise ValueError(
                f"corridor_gap_m {self.corridor_gap_m} and parked_car_width_m {self.parked_car_width_m} need a "
                f"width_m of at least {needed:g} with parked_sides {self.parked_sides}, got {narrowest}"
            )
        if self.n_parked_per_side * self.parked_car_length_m > self.corridor_length_m + 1e-6:
            raise ValueError(
                f"n_parked_per_side {self.n_parked_per_side} cars of {self.parked_car_length_m} m do not fit into "
                f"corridor_length_m {self.corridor_length_m} by their parked_car_length_m"
            )
        if self.n_corridors > 1 and self.between_corridors_m < self.swerve_length_m + 2 * self.swerve_margin_m:
            raise ValueError(
                f"between_corridors_m must be at least swerve_length_m + 2 swerve_margin_m = "
                f"{self.swerve_length_m + 2 * self.swerve_margin_m:g}, got {self.between_corridors_m}"
            )
        check_bends(self.bends, max(self.width_m, *(change.width_m for change in self.width_changes), 0.0))
        check_width_changes(self.width_changes, self.corridors_m)
        check_bays(self.bays, self.parked_car_length_m, self.parked_car_width_m)

    @property
    def _needed_m(self) -> float:
        """Width of the road that its parked cars and the gap need."""
        return self.corridor_gap_m + (2 if self.parked_sides == "both" else 1) * self.parked_car_width_m

    @property
    def is_closed_form(self) -> bool:
        """Whether `OneStreet` can compute it: one width, one corridor of evenly parked cars, no bays."""
        is_even = self.parked_empty_share == 0 and self.parked_irregularity == 0
        return self.n_corridors == 1 and is_even and not self.width_changes and not self.bays

    def width_at(self, sigma: Tensor) -> Tensor:
        """[...] m: distance from kerb to kerb at sigma [...]."""
        return width_at(sigma, self.width_m, self.width_changes)

    @property
    def widths_m(self) -> list[float]:
        """Width of the road at each corridor."""
        middles = [(first + last) / 2 for first, last in self.corridors_m]
        at: list[float] = self.width_at(torch.tensor(middles, dtype=torch.float64)).tolist()
        return at

    @property
    def corridors_m(self) -> list[tuple[float, float]]:
        """First and last sigma of each corridor, ascending; all together have their middle at 0."""
        step = self.corridor_length_m + self.between_corridors_m
        first = -(self.corridor_length_m + (self.n_corridors - 1) * step) / 2
        return [(first + i * step, first + i * step + self.corridor_length_m) for i in range(self.n_corridors)]

    @property
    def sides(self) -> list[tuple[int, ...]]:
        """Sides of the cars parked at each corridor: +1 left of the line, -1 right of it."""
        if self.parked_sides == "alternating":
            return [(1,) if i % 2 == 0 else (-1,) for i in range(self.n_corridors)]
        return [{"both": (-1, 1), "left": (1,), "right": (-1,)}[self.parked_sides]] * self.n_corridors

    @property
    def gap_middles_m(self) -> list[float]:
        """d (m) of each corridor's middle line: between the parked cars, or between them and the opposite kerb."""
        places = zip(self.sides, self.widths_m, strict=True)
        return [-sum(sides) * (width_m - self.corridor_gap_m) / 2 for sides, width_m in places]

    @property
    def reach_m(self) -> float:
        """Distance from the corridor's middle beyond which the street is straight and empty, m."""
        ends = [abs(sigma) for bend in self.bends for sigma in (bend.start_m, bend.start_m + bend.length_m)]
        ends += [abs(sigma) for change in self.width_changes for sigma in (change.start_m, change.end_m)]
        return max([self.corridors_m[-1][1] + self.swerve_margin_m + self.swerve_length_m, *ends])


@schema
class StreetsConfig:
    """Streets of a road whose sizes are intervals.

    n_training: different streets in training
    n_held_out: different streets in the evaluation; training sees none of them
    seed: of all streets
    clearance_m: room beside a vehicle that drives on its route; a street with less is drawn again
    curvature_max_1pm: sharpest bend of a route; a street with a sharper one is drawn again
    """

    n_training: PositiveInt
    n_held_out: PositiveInt
    seed: Seed
    clearance_m: NonNegativeMetres
    curvature_max_1pm: PositiveFloat


@schema
class RoadConfig:
    """Sizes of a road in metres, each a number or the interval that it is drawn from, for every street anew.

    `conf/scenario/narrow_lane.yaml` says what each value means.
    """

    bends: tuple[BendConfig, ...]
    width_m: SizeRange
    width_changes: tuple[WidthChangeConfig, ...]
    bays: tuple[BayConfig, ...]
    lane_offset_m: SizeRange
    corridor_length_m: SizeRange
    corridor_gap_m: SizeRange
    n_corridors: CountRange
    between_corridors_m: DistanceRange
    parked_sides: ParkedSides | Annotated[tuple[ParkedSides, ...], Field(min_length=1)]
    parked_car_length_m: SizeRange
    parked_car_width_m: SizeRange
    n_parked_per_side: CountRange
    parked_empty_share: FractionRange
    parked_irregularity: FractionRange
    swerve_length_m: SizeRange
    swerve_margin_m: DistanceRange
    target_distance_m: SizeRange

    @model_validator(mode="after")
    def _fits(self) -> "RoadConfig":
        if not self.varies:
            self._street(torch.Generator())
        return self

    @property
    def _sizes(self) -> dict[str, Any]:
        """Its sizes by name, without those of its lists."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name not in LISTS}

    @property
    def varies(self) -> bool:
        """Whether streets differ: an interval, several sides, or cars parked irregularly."""
        items: tuple[Any, ...] = tuple(item for name in LISTS for item in getattr(self, name))
        values = [*self._sizes.values(), *(getattr(each, field.name) for each in items for field in fields(each))]
        is_drawn = any(isinstance(value, tuple) for value in values)
        return is_drawn or self.parked_empty_share != 0 or self.parked_irregularity != 0

    @property
    def intervals(self) -> str:
        """The sizes that streets are drawn with, for a message."""
        drawn = self._sizes
        texts = {name: list(value) for name, value in drawn.items() if isinstance(value, tuple)}
        texts |= {name: drawn[name] for name in ("parked_empty_share", "parked_irregularity") if drawn[name] != 0}
        return ", ".join(f"{name} {value}" for name, value in texts.items())

    @property
    def street(self) -> StreetConfig:
        """The only street of a road that does not vary."""
        return self._street(torch.Generator())

    def draw(self, n: int, generator: torch.Generator) -> list[StreetConfig]:
        """`n` streets; what does not fit is drawn again. UserError where nothing fits."""
        return [self._fitting(generator) for _ in range(n)]

    def _fitting(self, generator: torch.Generator) -> StreetConfig:
        reason: ValueError | None = None
        for _ in range(N_TRIES):
            try:
                return self._street(generator)
            except ValueError as error:
                reason = error
        raise UserError(
            f"scenario.road must leave streets that fit, none of {N_TRIES} does: {reason}; {self.intervals}"
        )

    def _street(self, generator: torch.Generator) -> StreetConfig:
        """One street; ValueError where something does not fit."""

        def number(value: Any) -> Any:
            if isinstance(value, tuple) and isinstance(value[0], str):
                return value[int(torch.randint(len(value), (), generator=generator))]
            if not isinstance(value, tuple):
                return value
            low, high = value
            if isinstance(low, int) and isinstance(high, int):
                return int(torch.randint(low, high + 1, (), generator=generator))
            return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

        def one(item: type, each: Any) -> Any:
            return item(*(number(getattr(each, field.name)) for field in fields(each)))

        drawn = {name: number(value) for name, value in self._sizes.items()}
        lists: dict[str, Any] = {
            name: tuple(one(item, each) for each in getattr(self, name)) for name, item in LISTS.items()
        }
        seed = int(torch.randint(2**31, (), generator=generator)) if self.varies else 0
        return StreetConfig(**lists, **drawn, parked_seed=seed)
