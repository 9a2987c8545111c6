"""Schemas of the configuration: one pydantic dataclass per component, with ranges in the types.

A component's dataclass is in the component's own file and has no defaults: every value is written once, in `conf/`.
Unknown keys, wrong types and values out of range raise a `pydantic.ValidationError`, which `negopipe.config.root` turns
into one line.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, PlainSerializer, PlainValidator, TypeAdapter
from pydantic.dataclasses import dataclass as pydantic_dataclass
from typing_extensions import dataclass_transform

from negopipe.environment import expanded


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


INFINITE = "inf"
"""Spelling of infinity in files: JSON has no number for it."""


def _from_plain(value: Any) -> Any:
    return math.inf if value == INFINITE else value


def _to_plain(value: float) -> float | str:
    return INFINITE if value == math.inf else value


Real = float
"""Any number. No number of a config may be infinite or NaN, but a horizon."""
PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
Horizon = Annotated[
    float,
    Field(ge=0, allow_inf_nan=True),
    BeforeValidator(_from_plain),
    PlainSerializer(_to_plain, when_used="json"),
]
"""Prediction horizon, s; infinity, or the text `inf`, gives way. `planner.give_way` must then be set."""


def _or_interval(number: Any) -> Any:
    """Type of a value of type `number` or of an interval [low, high] of such."""
    one = TypeAdapter(number)
    two = TypeAdapter(Annotated[list[number], Field(min_length=2, max_length=2), AfterValidator(_is_ordered)])

    def validate(value: Any) -> Any:
        if isinstance(value, list | tuple):
            return tuple(two.validate_python(list(value), strict=True))
        return one.validate_python(value, strict=True)

    def plain(value: Any) -> Any:
        return list(value) if isinstance(value, tuple) else value

    return Annotated[Any, PlainValidator(validate), PlainSerializer(plain)]


PositiveMetres = PositiveFloat
NonNegativeMetres = NonNegativeFloat
Fraction = Annotated[float, Field(ge=0, le=1)]
PositiveInt = Annotated[int, Field(ge=1)]
if TYPE_CHECKING:
    RealRange: TypeAlias = float | tuple[float, float]
    FractionRange: TypeAlias = float | tuple[float, float]
    SizeRange: TypeAlias = float | tuple[float, float]
    SpeedRange: TypeAlias = float | tuple[float, float]
    DistanceRange: TypeAlias = float | tuple[float, float]
    CountRange: TypeAlias = int | tuple[int, int]
else:
    RealRange, FractionRange = _or_interval(Real), _or_interval(Fraction)
    SizeRange, DistanceRange = _or_interval(PositiveMetres), _or_interval(NonNegativeMetres)
    SpeedRange = _or_interval(PositiveFloat)
    CountRange = _or_interval(PositiveInt)
"""A number, or the interval [low, high] that it is drawn from."""
NonNegativeInt = Annotated[int, Field(ge=0)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Label = Annotated[str, Field(min_length=1, max_length=100)]
Address = Annotated[str, Field(min_length=1)]
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=100)]
Interval = Annotated[tuple[NonNegativeFloat, NonNegativeFloat], AfterValidator(_is_ordered)]
PositiveInterval = Annotated[tuple[PositiveFloat, PositiveFloat], AfterValidator(_is_ordered)]
Distinct = AfterValidator(_has_no_twins)
"""Annotation of a list whose values must differ."""
PathText = Annotated[str, Field(min_length=1), AfterValidator(expanded)]
"""A path; a leading `~` is replaced."""
