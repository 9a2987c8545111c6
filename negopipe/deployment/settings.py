"""Values of an exported decision that the runtime needs, read from export.json; NumPy alone."""

from dataclasses import dataclass
from typing import Any, NamedTuple

from negopipe.deployment.history import Before
from negopipe.deployment.tables import Capacity
from negopipe.simulation.map_street import MapRules


class Footprint(NamedTuple):
    """Size of the ego, m."""

    length_m: float
    width_m: float


@dataclass(frozen=True)
class Settings:
    """Values of one export.

    dt_s: control step, s
    n_times: T, times of a plan
    n_past: K, states of the past that a decision reads, now among them
    n_others: N, other road users that a decision reads
    horizons_s: prediction horizons among which the policy chooses
    is_drawn: they are drawn by their probabilities, else the most probable one is taken
    accel_window_s: time over which another's acceleration is read off its speeds, s
    before: what is assumed of the time before the first message of a road user that appears during a drive: nothing
        where training knew vehicles that were not seen, else that it came with its speed and heading
    full_braking_mps2: deceleration of a stop without a plan
    ego: footprint
    gap_s, future_s, jump_m, replan_m, aside_m: `conf/export/onnx.yaml`, `runtime`
    capacity: of streets
    room_m: width that a vehicle needs between two parked cars
    rules: by which kerbs and parked vehicles become a street
    """

    dt_s: float
    n_times: int
    n_past: int
    n_others: int
    horizons_s: tuple[float, ...]
    is_drawn: bool
    accel_window_s: float
    before: Before
    full_braking_mps2: float
    ego: Footprint
    gap_s: float
    future_s: float
    jump_m: float
    replan_m: float
    aside_m: float
    capacity: Capacity
    room_m: float
    rules: MapRules

    @property
    def keep_s(self) -> float:
        """Time that is remembered, s."""
        return max((self.n_past - 1) * self.dt_s, self.accel_window_s) + self.dt_s

    @staticmethod
    def of(config: dict[str, Any]) -> "Settings":
        """config: of an export, as export.json holds it."""
        scenario, planner, observation = config["scenario"], config["planner"], config["observation"]
        capacity, dt_s = dict(config["export"]["capacity"]), scenario["dt_s"]
        n_others = capacity.pop("n_others")
        stride = max(1, round(observation["frame_interval_s"] / dt_s))
        ego = Footprint(scenario["vehicle"]["length_m"], scenario["vehicle"]["width_m"])
        widths = [bound for kind in scenario["kinds"].values() for bound in _bounds(kind["width_m"])]
        return Settings(
            dt_s=dt_s,
            n_times=round(planner["horizon_s"] / dt_s),
            n_past=1 + (observation["n_frames"] - 1) * stride,
            n_others=n_others,
            horizons_s=tuple(map(float, config["policy"]["horizons_s"])),  # JSON has inf as a text
            is_drawn=config["export"]["action"] == "sample",
            accel_window_s=config["perception"]["accel_window_s"],
            before="unknown" if _knows_unseen(config["perception"]) else "driven",
            full_braking_mps2=planner["limits"]["full_braking_mps2"],
            ego=ego,
            **config["export"]["runtime"],
            capacity=Capacity(**capacity),
            room_m=min([ego.width_m, *widths]) + 2 * planner["clearance"]["parked_near_m"],
            rules=_rules(scenario, ego),
        )


def _knows_unseen(perception: dict[str, Any]) -> bool:
    """Whether there are vehicles that are not seen."""
    is_limited = perception["range_m"] is not None or perception["occlusion"]
    return bool(is_limited or perception["dropout_probability"] > 0)


def _rules(scenario: dict[str, Any], ego: Footprint) -> MapRules:
    road, streets = scenario["road"], scenario["streets"]
    return MapRules(
        vehicle=ego,
        swerve_m=_middle(road["swerve_length_m"]),
        lane_m=_middle(road["lane_offset_m"]),
        target_m=_middle(road["target_distance_m"]),
        before_m=0.0,
        behind_m=0.0,
        clearance_m=streets["clearance_m"],
        curvature_max_1pm=streets["curvature_max_1pm"],
    )


def _bounds(value: Any) -> tuple[float, float]:
    """Lowest and highest value of a number or an interval."""
    return (value[0], value[1]) if isinstance(value, list) else (value, value)


def _middle(value: Any) -> float:
    """Middle of an interval from which training drew, or the number itself."""
    return sum(_bounds(value)) / 2
