"""Options of the closed loop with a car."""

from collections.abc import Iterator

from negopipe.checks import Problem
from negopipe.schema import Fraction, Interval, NonNegativeFloat, NonNegativeMetres, PositiveFloat, schema


@schema
class ActuatorConfig:
    """Lags and limits of pedals and steering."""

    accel_time_constant_s: PositiveFloat
    steer_time_constant_s: PositiveFloat
    accel_max_mps2: PositiveFloat
    decel_max_mps2: PositiveFloat


@schema
class ControllerConfig:
    """Gains of the tracking controller."""

    accel_lead_s: NonNegativeFloat
    speed_gain_1ps: NonNegativeFloat
    place_gain_1ps2: NonNegativeFloat
    steer_lead_s: NonNegativeFloat
    preview_least_m: NonNegativeMetres
    heading_gain: NonNegativeFloat
    left_gain_1ps: NonNegativeFloat
    softening_mps: PositiveFloat
    reverse_gain_1pm: NonNegativeFloat
    holding_mps: PositiveFloat


@schema
class LocalisationConfig:
    """Errors and age of the own state."""

    delay_s: NonNegativeFloat
    position_std_m: NonNegativeMetres
    yaw_std_rad: NonNegativeFloat
    speed_std_mps: NonNegativeFloat


@schema
class ObjectsConfig:
    """Rate, age, gaps and errors of the words of others."""

    seen_before_s: NonNegativeFloat
    period_s: PositiveFloat
    latency_s: Interval
    lost_frames: Fraction
    lost_objects: Fraction
    position_std_m: NonNegativeMetres
    yaw_std_rad: NonNegativeFloat
    speed_std_mps: NonNegativeFloat


@schema
class VehicleConfig:
    """`conf/vehicle/real_car.yaml` says what each value means."""

    plant_s: PositiveFloat
    control_s: PositiveFloat
    hand_over_mps: PositiveFloat
    decision_delay_s: NonNegativeFloat
    actuators: ActuatorConfig
    controller: ControllerConfig
    localisation: LocalisationConfig
    objects: ObjectsConfig

    def check(self, dt_s: float) -> Iterator[Problem]:
        """dt_s: control step of the scenario."""
        for name, step_s, whole_s in (
            ("vehicle.plant_s", self.plant_s, self.control_s),
            ("vehicle.control_s", self.control_s, dt_s),
        ):
            if abs(whole_s / step_s - round(whole_s / step_s)) > 1e-6 or step_s > whole_s:
                yield Problem(name, f"divide {whole_s} s into whole steps", step_s)
