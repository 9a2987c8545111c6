"""Configuration of the safety layer."""

from typing import Annotated, Literal

from pydantic import Field

from negopipe.planner.lateral import LateralConfig
from negopipe.schema import NonNegativeFloat, NonNegativeMetres, PositiveFloat, PositiveMetres, schema


@schema
class NoSafetyConfig:
    """Every plan is driven as it is."""

    kind: Literal["none"]


@schema
class MotionLimitConfig:
    """What the vehicle can do; `conf/safety/rss.yaml` says what each value means."""

    speed_max_mps: PositiveFloat
    accel_max_mps2: PositiveFloat
    decel_max_mps2: PositiveFloat
    lateral_accel_max_mps2: PositiveFloat
    curvature_max_1pm: PositiveFloat
    tolerance_mps: NonNegativeFloat


@schema
class AssumedConfig:
    """What other vehicles may do; `conf/safety/rss.yaml` says what each value means."""

    speed_max_mps: PositiveFloat
    accel_max_mps2: PositiveFloat
    decel_max_mps2: PositiveFloat
    response_s: NonNegativeFloat
    braking_mps2: PositiveFloat
    offset_decay_m: PositiveMetres


@schema
class RssConfig:
    """The rule of `negopipe.safety.layer`; `conf/safety/rss.yaml` says what each value means."""

    kind: Literal["rss"]
    limits: MotionLimitConfig
    comfortable_mps2: PositiveFloat
    hold_s: NonNegativeFloat
    others: AssumedConfig
    parked_m: NonNegativeMetres
    ahead_m: NonNegativeMetres
    beside_m: NonNegativeMetres
    stops: LateralConfig


AnySafetyConfig = NoSafetyConfig | RssConfig
SafetyConfig = Annotated[AnySafetyConfig, Field(discriminator="kind")]
