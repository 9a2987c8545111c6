"""Configuration of the planner."""

import math
from collections.abc import Iterator

from pydantic import model_validator

from negopipe.checks import FLOAT_BYTES, N_TEMPORARIES, Memory, Problem, check_times
from negopipe.planner.braking import BrakingConfig
from negopipe.planner.give_way import GiveWayConfig
from negopipe.planner.lateral import LateralConfig
from negopipe.planner.longitudinal import LongitudinalConfig
from negopipe.planner.prediction import PredictionConfig
from negopipe.planner.reversing import ReversingConfig
from negopipe.schema import NonNegativeFloat, NonNegativeMetres, PositiveFloat, PositiveMetres, schema
from negopipe.simulation.geometry import Size
from negopipe.simulation.scenario import ScenarioConfig


@schema
class LimitConfig:
    """Limits of a trajectory; `full_braking_mps2` is the deceleration when no candidate is feasible."""

    speed_max_mps: PositiveFloat
    accel_max_mps2: PositiveFloat
    decel_max_mps2: PositiveFloat
    jerk_max_mps3: PositiveFloat
    lateral_accel_max_mps2: PositiveFloat
    curvature_max_1pm: PositiveFloat
    full_braking_mps2: PositiveFloat


@schema
class ClearanceConfig:
    """Clearances of planned footprints; the simulator checks collisions without them.

    parked_near_m: clearance to kerbs and parked cars at the vehicle itself. It grows along the path to parked_m, which
        it reaches parked_full_at_m ahead. A path that was drivable from afar therefore stays drivable from near, small
        errors included (constraint tightening, Richards & How 2006), and a vehicle can leave every place it stops at
    beside_s: additional clearance beside a vehicle, per m/s of its speed. A vehicle that waits for a moving one leaves
        it more room than that needs to creep past a standing one, so a waiting place can be passed
    """

    parked_m: NonNegativeMetres
    parked_near_m: NonNegativeMetres
    parked_full_at_m: PositiveMetres
    ahead_m: NonNegativeMetres
    beside_m: NonNegativeMetres
    beside_s: NonNegativeFloat
    station_m: PositiveMetres
    conflict_station_m: PositiveMetres

    @model_validator(mode="after")
    def _grows(self) -> "ClearanceConfig":
        if self.parked_near_m > self.parked_m:
            raise ValueError(f"parked_near_m {self.parked_near_m} must be at most parked_m {self.parked_m}")
        return self


@schema
class CostConfig:
    """Weights of the conjoint cost; `conf/planner/frenet.yaml` says what each term is."""

    jerk: NonNegativeFloat
    speed: NonNegativeFloat
    offset: NonNegativeFloat
    bend: NonNegativeFloat
    hard_braking: NonNegativeFloat
    closeness: NonNegativeFloat
    lingering: NonNegativeFloat


@schema
class PlannerConfig:
    """`conf/planner/frenet.yaml` says what each value means.

    leader_horizon_s: null = vehicles in the same direction are predicted like any other
    give_way: null = an infinite prediction horizon is one of the whole plan
    reversing: null = nobody drives backwards
    """

    horizon_s: PositiveFloat
    longitudinal: LongitudinalConfig
    braking: BrakingConfig
    leader_horizon_s: PositiveFloat | None
    give_way: GiveWayConfig | None
    reversing: ReversingConfig | None
    lateral: LateralConfig
    limits: LimitConfig
    clearance: ClearanceConfig
    cost: CostConfig
    prediction: PredictionConfig

    @property
    def lowest_speed_mps(self) -> float:
        """Lowest speed of a vehicle, m/s; negative where vehicles may drive backwards."""
        return -self.reversing.speed_mps if self.reversing else 0.0

    def n_times(self, dt_s: float) -> int:
        """T, control steps of a plan."""
        return round(self.horizon_s / dt_s)

    @property
    def n_stations(self) -> int:
        """S, points along a path at which it is checked against kerbs and parked cars."""
        return int(self.limits.speed_max_mps * self.horizon_s / self.clearance.station_m) + 1

    def touching_m(self, largest: Size) -> float:
        """Distance at which two footprints with their clearances can touch at all."""
        clearance, half_length, half_width = self.clearance, largest.length / 2, largest.width / 2
        beside = clearance.beside_m + clearance.beside_s * self.limits.speed_max_mps
        return math.hypot(half_length, half_width) + math.hypot(half_length + clearance.ahead_m, half_width + beside)

    def n_around(self, largest: Size) -> int:
        """K, points around a predicted vehicle at which a path is checked against it."""
        return math.ceil(2 * self.touching_m(largest) / self.clearance.conflict_station_m) + 1

    def check(self, dt_s: float) -> Iterator[Problem]:
        yield from check_times({"planner.horizon_s": (self.horizon_s,)}, dt_s)

    def memory(self, scenario: ScenarioConfig, n_worlds: int) -> Memory:
        """Memory of one plan of every vehicle in `n_worlds` worlds."""
        n_paths = n_worlds * scenario.n_vehicles * self.lateral.n_candidates
        n_met = scenario.n_others * self.n_times(scenario.dt_s)
        n_candidates = self.longitudinal.n_candidates + self.braking.n_candidates
        n_checks = n_met * (n_candidates + self.n_around(scenario.sizes.largest)) + self.n_stations
        keys = (
            "scenario.n_social scenario.n_followers planner.horizon_s scenario.dt_s planner.longitudinal.keep_fractions"
        )
        keys += " planner.lateral.offsets_m planner.clearance.station_m planner.clearance.conflict_station_m"
        return Memory("a plan", n_paths * n_checks * FLOAT_BYTES * N_TEMPORARIES, tuple(keys.split()))
