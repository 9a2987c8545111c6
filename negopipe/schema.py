"""How a component declares its configuration: one pydantic dataclass, ranges in the types.

A component's dataclass lives in the component's own file and has no defaults: every value is written once,
in `conf/`. Unknown keys are refused, wrong types and values out of range raise a `pydantic.ValidationError`
that `negopipe.config` turns into one line.
"""

from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass
from typing_extensions import dataclass_transform


@dataclass_transform(frozen_default=True)
def schema(cls: type) -> type:
    """Class decorator: a frozen, typed, range-checked configuration dataclass that refuses unknown keys."""
    return pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))(cls)


def _is_ordered(interval: tuple[float, float]) -> tuple[float, float]:
    if interval[0] > interval[1]:
        raise ValueError("must be [low, high] with low <= high")
    return interval


PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
PositiveInt = Annotated[int, Field(ge=1)]
NonNegativeInt = Annotated[int, Field(ge=0)]
Interval = Annotated[tuple[NonNegativeFloat, NonNegativeFloat], AfterValidator(_is_ordered)]
