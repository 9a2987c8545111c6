"""Every metric on traces of a few steps whose answers are worked out by hand."""

import json
import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.measures import summary
from negopipe.evaluation.metrics import behaviour_index, passes_first, suspensions
from negopipe.evaluation.trace import OUTCOMES, Trace

DT_S = 0.2
CORRIDOR_M = 12.0


def make_trace(ego_speed: list[float], n_steps: int, reached: tuple[int, int], outcome: str) -> Trace:
    """One episode of a single ego and a single social vehicle; ego_speed has T+1 entries, m/s."""
    n_states = len(ego_speed)
    speed = np.stack([np.array(ego_speed), np.full(n_states, 3.0)], -1)[:, None].astype(np.float32)
    travelled = np.cumsum(np.concatenate([np.zeros((1, 1, 2)), speed[1:] * DT_S]), 0)
    start = np.array([[13.0, 6.5]], dtype=np.float32)
    progress = (travelled - start).astype(np.float32)
    return Trace(
        planner="fixed_2",
        setting="push",
        dt_s=DT_S,
        street=np.ones(len(start), dtype=np.int64),
        corridor_m=np.full(len(start), CORRIDOR_M, dtype=np.float32),
        start_distance_m=start,
        style_horizon_s=np.array([[np.nan, 6.0]], dtype=np.float32),
        length_m=np.full((1, 2), 4.5, dtype=np.float32),
        width_m=np.full((1, 2), 1.8, dtype=np.float32),
        driver=np.array([["", "planner"]]),
        position_m=np.zeros((n_states, 1, 2, 2), dtype=np.float32),
        yaw_rad=np.zeros((n_states, 1, 2), dtype=np.float32),
        speed_mps=speed,
        progress_m=progress,
        horizon_s=np.full((n_states - 1, 1, 2), 2.0, dtype=np.float32),
        is_full_braking=np.zeros((n_states - 1, 1, 2), dtype=bool),
        intervention=np.zeros((n_states - 1, 1), dtype=np.int8),
        reward=np.full((n_states - 1, 1), -0.25, dtype=np.float32),
        n_steps=np.array([n_steps]),
        reached_step=np.array([reached]),
        outcome=np.array([OUTCOMES.index(outcome)]),
    )


def drives_of(trace: Trace) -> Drives:
    return Drives(trace, braking_mps2=8.0, plan_s=6.0)


def concatenate(*traces: Trace) -> Trace:
    """Several one-episode traces of equal length as one trace."""
    axis = {"start_distance_m": 0, "style_horizon_s": 0, "driver": 0, "n_steps": 0, "reached_step": 0, "outcome": 0}
    axis |= dict.fromkeys(("position_m", "yaw_rad", "speed_mps", "progress_m"), 1)
    axis |= dict.fromkeys(("horizon_s", "is_full_braking", "intervention", "reward"), 1)
    merged = {name: np.concatenate([getattr(t, name) for t in traces], i) for name, i in axis.items()}
    return replace(traces[0], **merged)


@pytest.mark.parametrize(
    ("ego_speed", "n_steps", "ego_reached", "count", "n_rest"),
    [
        ([4, 3, 2, 1, 0.6, 0.3], 5, -1, 0, 0),  # slow is not at rest
        ([4, 1, 0.05, 0.0, 0.0, 2], 5, -1, 1, 3),  # one stop of three states
        ([4, 0.05, 0.3, 0.05, 0.3, 2], 5, -1, 1, 2),  # creeping below 0.5 m/s does not make a second stop
        ([4, 0.05, 0.6, 0.05, 0.6, 2], 5, -1, 2, 2),  # having moved again does
        ([0, 0, 0, 0.4, 0, 0], 5, -1, 0, 0),  # never moved above 0.5 m/s
        ([4, 1, 0.0, 0.0, 0.0, 0.0], 3, -1, 1, 2),  # states after the end repeat and do not count
        ([4, 4, 4, 0.0, 0.0, 0.0], 5, 2, 0, 0),  # standing beyond the target does not count
    ],
)
def test_suspensions(ego_speed: list[float], n_steps: int, ego_reached: int, count: int, n_rest: int) -> None:
    trace = make_trace(ego_speed, n_steps, (ego_reached, -1), "timeout")
    counts, times = suspensions(trace)
    assert counts.tolist() == [count]
    assert times.tolist() == pytest.approx([n_rest * DT_S])


def test_suspensions_of_a_batch_equal_those_of_its_episodes() -> None:
    speeds = ([4, 0.0, 1, 0.0, 1, 1], [4, 4, 4, 4, 4, 4], [4, 0.0, 0.0, 0.0, 0.0, 0.0])
    single = [make_trace(list(speed), 5, (-1, -1), "timeout") for speed in speeds]
    counts, times = suspensions(concatenate(*single))
    assert counts.tolist() == [suspensions(trace)[0][0] for trace in single] == [2, 0, 1]
    assert times.tolist() == pytest.approx([suspensions(trace)[1][0] for trace in single])


def test_row_of_a_success() -> None:
    trace = make_trace([4, 0.0, 4, 4, 4, 4], 4, (3, 4), "success")
    trace.is_full_braking[:, 0, :] = np.array([[1, 1], [0, 1], [1, 0], [0, 0], [1, 1]], dtype=bool)
    trace.horizon_s[:, 0, 0] = [0, 6, 6, 2, 99]  # the last decision lies after the end
    row = episodes(drives_of(trace)).iloc[0]
    assert (row["planner"], row["setting"], row["episode"]) == ("fixed_2", "push", 0)
    assert (row["outcome"], row["n_decisions"]) == ("success", 4)
    assert (row["ego_start_distance_m"], row["social_start_distance_m"]) == (13.0, 6.5)
    assert row["style_horizon_s"] == 6.0
    assert row["ego_time_s"] == row["driving_time_s"] == pytest.approx(0.6)
    assert row["social_time_s"] == pytest.approx(0.8)
    assert (row["suspend_count"], row["suspend_time_s"]) == (1, pytest.approx(0.2))
    assert row["reward"] == pytest.approx(-1.0)  # four decisions, not five
    assert row["full_braking_count"] == 2
    assert row["mean_horizon_s"] == pytest.approx(3.5)


def test_row_of_a_crash_has_no_times() -> None:
    trace = make_trace([4, 4, 4], 2, (-1, -1), "collision")
    trace.horizon_s[:, 0, 0] = np.nan
    row = episodes(drives_of(trace)).iloc[0]
    assert row["outcome"] == "collision"
    assert row[["ego_time_s", "social_time_s", "driving_time_s", "mean_horizon_s"]].isna().all()
    assert row["passes_first"] == "none"


def test_the_first_to_leave_the_corridor_passes_first() -> None:
    ego, social, none = (make_trace([4] * 4, 3, (-1, -1), "timeout") for _ in range(3))
    ego.progress_m[:, 0] = [[-13, -6], [5, 3], [12.5, 5], [20, 13]]
    social.progress_m[:, 0] = [[-13, -6], [0, 3], [0, 12.5], [13, 20]]
    none.progress_m[:, 0] = [[-13, -6], [0, 3], [3, 5], [5, 12.0]]  # at the far end is not yet beyond it
    assert passes_first(concatenate(ego, social, none)).tolist() == ["ego", "social", "none"]


def test_behaviour_index_is_equation_7() -> None:
    trace = make_trace([4] * 4, 2, (-1, -1), "timeout")
    trace.progress_m[:, 0] = [[-13, -6.5], [-12, -4.5], [-8, -5.5], [-8, -5.5]]
    psi = behaviour_index(trace)[:, 0]
    # distances travelled: ego 0, 1, 5 m; social 0, 2, 1 m; initial distances 13 and 6.5 m, ratio 2
    assert psi[:3].tolist() == pytest.approx([0.0, math.atan(1 / 2), math.atan(-4 / 2)])
    assert np.isnan(psi[3])


def table() -> pd.DataFrame:
    """Two settings, the first with two planners; planner `a` has one episode of every outcome."""
    rows = [
        ("a", "push", "success", 8.0, 12.0, 0, 0.0, 0, 1.0, "ego"),
        ("a", "push", "collision", np.nan, np.nan, 0, 0.0, 3, -11.0, "none"),
        ("a", "push", "deadlock", np.nan, np.nan, 1, 14.0, 0, -32.0, "none"),
        ("a", "push", "timeout", 20.0, 13.0, 2, 4.0, 2, -32.0, "ego"),
        ("b", "push", "deadlock", np.nan, np.nan, 1, 15.0, 0, -32.0, "none"),
        ("a", "yield", "success", 14.0, 7.0, 1, 3.0, 0, -7.0, "social"),
    ]
    driven = ["driving_time_s", "social_time_s", "suspend_count", "suspend_time_s", "full_braking_count", "reward"]
    driven += ["passes_first"]
    return pd.DataFrame(rows, columns=["planner", "setting", "outcome", *driven])


def test_summary_by_hand() -> None:
    evaluation = summary(table())["evaluation"]
    assert list(evaluation) == ["push", "yield"]
    assert list(evaluation["push"]) == ["a", "b"]
    low, high = 0.0456, 0.6994  # Wilson (1927): 1 of 4
    assert evaluation["push"]["a"] == {
        "success_rate": 0.25,
        "success_low": pytest.approx(low, abs=1e-4),
        "success_high": pytest.approx(high, abs=1e-4),
        "collision_rate": 0.25,
        "collision_low": pytest.approx(low, abs=1e-4),
        "collision_high": pytest.approx(high, abs=1e-4),
        "timeout_rate": 0.5,
        "deadlock_rate": 0.25,
        "social_collision_rate": 0.0,
        "arrival_rate": 0.5,
        "ego_first_rate": 0.5,
        "driving_time_s": 14.0,
        "social_time_s": 12.5,
        "suspend_count": 0.75,
        "suspend_time_s": 4.5,
        "full_braking_count": 1.25,
        "reward": -18.5,
        "n_episodes": 4,
    }
    assert evaluation["yield"]["a"]["driving_time_s"] == 14.0


def test_summary_without_arrivals_is_null_in_json() -> None:
    measures = summary(table())["evaluation"]["push"]["b"]
    assert measures["driving_time_s"] is None
    assert measures["arrival_rate"] == 0.0
    assert json.loads(json.dumps(measures, allow_nan=False)) == measures


def test_collisions_are_told_apart_by_who_could_have_avoided_them() -> None:
    whose = ["none", "ego", "both", "nobody", "social", "alone"]
    measures = summary(table().assign(planner="a", setting="push", avoidable_by=whose))["evaluation"]["push"]["a"]
    share = {name: measures[name] for name in measures if name.startswith("avoidable")}
    assert share == {
        "avoidable_rate": pytest.approx(2 / 6),
        "avoidable_by_ego_rate": pytest.approx(1 / 6),
        "avoidable_by_social_rate": pytest.approx(1 / 6),
        "avoidable_by_both_rate": pytest.approx(1 / 6),
    }
