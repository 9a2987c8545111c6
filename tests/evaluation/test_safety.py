"""Gaps, times to collision, hardness and blame, against values worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from hand_driven import in_a_line

from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.safety import avoidable_by, box_distance, footprints, smallest_gap
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.simulation.geometry import Boxes, boxes_from_pose, overlap_depth, time_to_collision

BRAKING_MPS2 = 8.0


def box(x: float, y: float, yaw: float) -> Boxes:
    pose = (torch.tensor(value, dtype=torch.float64) for value in (x, y, yaw))
    return boxes_from_pose(*pose, length=4.0, width=2.0)


@pytest.mark.parametrize(
    ("x", "y", "yaw", "distance"),
    [
        (7.0, 0.0, 0.0, 3.0),  # bumper to bumper
        (1.0, -2.5, math.pi, 0.5),  # side by side
        (7.0, 6.0, 0.0, 5.0),  # corner to corner: 3 ahead, 4 aside
        (6.0, 0.0, math.pi / 2, 3.0),  # across the road
        (2.0 + math.sqrt(2) * 1.5 + 1.0, 0.0, math.pi / 4, 1.0),  # its corner towards this bumper
        (3.9, 0.0, 0.0, 0.0),
        (0.0, 0.0, math.pi / 2, 0.0),  # a cross: no corner of one lies in the other
    ],
)
def test_distance_of_hand_placed_rectangles(x: float, y: float, yaw: float, distance: float) -> None:
    here, there = box(0, 0, 0), box(x, y, yaw)
    assert box_distance(here, there).item() == pytest.approx(distance, abs=1e-12)
    assert box_distance(there, here).item() == pytest.approx(distance, abs=1e-12)


def make_trace(social_x_m: list[list[float]]) -> Trace:
    """One episode; the ego stands at the origin, the social vehicles [T+1, V-1] ahead of it, turned around."""
    x = np.pad(np.float32(social_x_m), ((0, 0), (1, 0)))
    return in_a_line(x, yaw=(0.0, *[np.pi] * (x.shape[1] - 1)))


@pytest.mark.parametrize(
    ("social_x_m", "gap_m"), [([[20.0, 40.0], [9.0, 30.0], [12.0, 8.0]], 4.0), ([[9.0], [3.0], [9.0]], 0.0)]
)
def test_smallest_gap_is_over_time_and_all_social_vehicles(social_x_m: list[list[float]], gap_m: float) -> None:
    gap = smallest_gap(footprints(make_trace(social_x_m)))
    assert gap.tolist() == pytest.approx([gap_m], abs=1e-5)


@pytest.mark.parametrize(
    ("x", "y", "yaw", "velocity", "seconds"),
    [
        (24.0, 0.0, math.pi, (-10.0, 0.0), 2.0),  # nose to nose, 20 m apart
        (24.0, 1.9, math.pi, (-10.0, 0.0), 2.0),  # ... with an overlap of 10 cm
        (24.0, 2.1, math.pi, (-10.0, 0.0), math.inf),  # past each other
        (24.0, 0.0, math.pi, (10.0, 0.0), math.inf),  # away from each other
        (24.0, 0.0, math.pi, (0.0, 0.0), math.inf),
        (0.0, 12.0, math.pi / 2, (0.0, -3.0), 3.0),  # from the side: 12 - 1 - 2 = 9 m
        (3.0, 0.0, 0.0, (5.0, 0.0), 0.0),  # they overlap already
    ],
)
def test_time_to_collision_by_hand(
    x: float, y: float, yaw: float, velocity: tuple[float, float], seconds: float
) -> None:
    moving = torch.tensor(velocity, dtype=torch.float64)
    assert time_to_collision(box(0, 0, 0), box(x, y, yaw), *moving.unbind(-1)).item() == pytest.approx(seconds)
    assert time_to_collision(box(x, y, yaw), box(0, 0, 0), *(-moving).unbind(-1)).item() == pytest.approx(seconds)


def test_time_to_collision_agrees_with_trying_out() -> None:
    random = np.random.default_rng(0)
    n, times = 300, torch.arange(0, 12, 0.01, dtype=torch.float64)
    x, y, yaw = (torch.from_numpy(random.uniform(-r, r, n)) for r in (15, 15, math.pi))
    velocity = torch.from_numpy(random.uniform(-4, 4, (n, 2)))
    own = boxes_from_pose(*torch.from_numpy(random.uniform(-1, 1, (3, n))), 4.0, 2.0)
    found = time_to_collision(own, boxes_from_pose(x, y, yaw, 4.0, 2.0), *velocity.unbind(-1))
    at = (part[:, None] + velocity[:, i : i + 1] * times for i, part in enumerate((x, y)))
    there = boxes_from_pose(*at, yaw[:, None].expand(-1, len(times)), 4.0, 2.0)
    here = own._replace(x=own.x[:, None], y=own.y[:, None], cos=own.cos[:, None], sin=own.sin[:, None])
    is_hit = overlap_depth(here, there) > 0
    tried = torch.where(is_hit.any(1), times[is_hit.int().argmax(1)], torch.inf)
    is_soon = found < 11.9
    assert 0.1 < is_soon.float().mean() < 0.9
    assert torch.equal(is_soon, tried < 11.95)
    assert torch.allclose(found[is_soon], tried[is_soon], atol=0.0101)


def drive(ego_mps: list[float], social_mps: list[float], apart_m: float) -> Trace:
    """One episode that ends in a collision: both on one line, towards each other, speeds by step."""
    speed = np.float32([ego_mps, social_mps]).T[:, None]
    moved = np.concatenate([np.zeros((1, 1, 2)), 0.2 * (speed[1:] + speed[:-1]) / 2]).cumsum(0)
    x = np.stack([moved[..., 0], apart_m - moved[..., 1]], -1)
    still = make_trace([[0.0]] * len(x))
    return replace(
        still,
        position_m=np.stack([x, np.zeros_like(x)], -1).astype(np.float32),
        speed_mps=speed,
        outcome=np.array([OUTCOMES.index("collision")]),
    )


STEADY, STANDING = [5.0] * 16, [0.0] * 16


@pytest.mark.parametrize(
    ("ego_mps", "social_mps", "apart_m", "who"),
    [
        (STEADY, STEADY, 33.9, "both"),  # 30 m of driving, 4 m of cars: they touch in the last step
        (STANDING, STEADY, 18.9, "social"),
        (STEADY, STANDING, 18.9, "ego"),
        ([30.0] * 16, [30.0] * 16, 183.9, "nobody"),  # 120 m between them, 56 m to brake: met after 2.2 s
        (STEADY, STEADY, 40.0, "alone"),  # what it hit was no vehicle
    ],
)
def test_who_could_have_avoided_it(ego_mps: list[float], social_mps: list[float], apart_m: float, who: str) -> None:
    trace = drive(ego_mps, social_mps, apart_m)
    assert avoidable_by(trace, BRAKING_MPS2).tolist() == [who]
    unharmed = replace(trace, outcome=np.array([OUTCOMES.index("success")]))
    assert avoidable_by(unharmed, BRAKING_MPS2).tolist() == ["none"]


def test_weaker_brakes_avoid_less() -> None:
    trace = drive(STEADY, STANDING, 18.9)
    assert avoidable_by(trace, 0.5).tolist() == ["nobody"]


def row_of(trace: Trace) -> pd.Series:
    return episodes(Drives(trace, BRAKING_MPS2, plan_s=6.0)).iloc[0]


def test_a_row_of_measures() -> None:
    """Braking from 5 to 3 m/s in one step and letting go again, before who stands 18.9 m away."""
    ego = [5.0, 5.0, 3.0, 3.0, 3.0, 3.0]
    row = row_of(drive(ego, [0.0] * 6, 18.9))
    assert row["largest_decel_mps2"] == pytest.approx(10.0, rel=1e-5)
    assert row["largest_jerk_mps3"] == pytest.approx(50.0, rel=1e-5)
    driven = 0.2 * (5.0 + 4.0 + 3 * 3.0)
    assert row["smallest_gap_m"] == pytest.approx(18.9 - 4 - driven, abs=1e-4)
    at_five = (18.9 - 4 - 1.0) / 5.0  # the last moment at 5 m/s; at 3 m/s they are farther apart in time
    assert row["smallest_ttc_s"] == pytest.approx(at_five, abs=1e-4)
    parted = row_of(drive([0.0] * 6, [0.0] * 6, 18.9))
    assert math.isnan(parted["smallest_ttc_s"])
    assert parted["largest_decel_mps2"] == parted["largest_jerk_mps3"] == 0


def test_what_comes_after_the_end_counts_for_nothing() -> None:
    ego = [5.0, 5.0, 5.0, 0.0, 0.0, 0.0]
    trace = replace(drive(ego, [0.0] * 6, 60.0), n_steps=np.array([2]))
    row = row_of(trace)
    assert row["largest_decel_mps2"] == row["largest_jerk_mps3"] == 0
