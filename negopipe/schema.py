"""How a component declares its configuration: one pydantic dataclass, ranges in the types.

A component's dataclass lives in the component's own file and has no defaults: every value is written once,
in `conf/`. Unknown keys are refused, wrong types and values out of range raise a `pydantic.ValidationError`
that `negopipe.config.root` turns into one line.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Annotated, TypeVar

from pydantic import AfterValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass
from typing_extensions import dataclass_transform

from negopipe.environment import expanded

LARGEST = 1e6
"""Of any number. Roads, speeds and weights are far below it, and float32, which ends at 3e38, holds its powers."""

SMALLEST = 1e-6
"""Of a number that is divided by, with the same in mind: float32 begins at 1e-38."""

LONGEST_VIEW_M = 1000.0
"""Of any length on the road: the longest view."""

N_MOST = 10**6
"""Of any count. What some of them make together has a bound of its own, in `negopipe.config.root`."""


@dataclass_transform(frozen_default=True)
def schema(cls: type) -> type:
    """Class decorator: a frozen, typed, range-checked configuration dataclass that refuses unknown keys."""
    return pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))(cls)


T = TypeVar("T", bound=Sequence)


def _has_no_twins(values: T) -> T:
    twins = [value for value, n in Counter(values).items() if n > 1]
    if twins:
        raise ValueError(f"must name every value once, not {twins[0]} again")
    return values


def _is_ordered(interval: tuple[float, float]) -> tuple[float, float]:
    if interval[0] > interval[1]:
        raise ValueError("must be [low, high] with low <= high")
    return interval


def _is_not_tiny(value: float) -> float:
    if value < SMALLEST:
        raise ValueError(f"must be at least {SMALLEST:g}")
    return value


def _is_printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("must be of printable characters")
    return text


def _is_path(text: str) -> str:
    """The path with `~` replaced, for every key that is one. No file system takes longer names."""
    if not text.isprintable() or len(text) > 1000 or max(len(part.encode()) for part in text.split("/")) > 255:
        raise ValueError("must be a path of printable characters, at most 1000 in all and 255 bytes between two /")
    return expanded(text)


Real = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
PositiveFloat = Annotated[float, Field(gt=0, le=LARGEST), AfterValidator(_is_not_tiny)]
NonNegativeFloat = Annotated[float, Field(ge=0, le=LARGEST)]
PositiveMetres = Annotated[float, Field(gt=0, le=LONGEST_VIEW_M), AfterValidator(_is_not_tiny)]
NonNegativeMetres = Annotated[float, Field(ge=0, le=LONGEST_VIEW_M)]
Fraction = Annotated[float, Field(ge=0, le=1)]
PositiveInt = Annotated[int, Field(ge=1, le=N_MOST)]
NonNegativeInt = Annotated[int, Field(ge=0, le=N_MOST)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Label = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_is_printable)]
Address = Annotated[str, Field(min_length=1, max_length=2000), AfterValidator(_is_printable)]
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=100)]
Interval = Annotated[tuple[NonNegativeFloat, NonNegativeFloat], AfterValidator(_is_ordered)]
PositiveInterval = Annotated[tuple[PositiveFloat, PositiveFloat], AfterValidator(_is_ordered)]
Distinct = AfterValidator(_has_no_twins)
"""Annotation of a list in which a value that comes twice would be done twice, or be two of one name."""
PathText = Annotated[str, Field(min_length=1), AfterValidator(_is_path)]
