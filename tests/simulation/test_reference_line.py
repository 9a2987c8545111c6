"""Bends by hand, against finite differences, and exact both ways between the line and the world."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from negopipe.simulation.reference_line import REACH_M, Bend, ReferenceLine, check_bends

SHARPEST = 15 / 8  # largest slope of the smooth step: a bend's sharpest curvature is this times angle / length


def bend_of_radius(start_m: float, radius_m: float, angle_deg: float) -> Bend:
    return Bend(start_m, SHARPEST * math.radians(abs(angle_deg)) * radius_m, angle_deg)


QUARTER = [bend_of_radius(-20.0, 20.0, 90.0)]
S_CURVE = [bend_of_radius(-45.0, 20.0, 40.0), bend_of_radius(5.0, 25.0, -60.0)]
bent = pytest.mark.parametrize("bends", [QUARTER, S_CURVE], ids=["quarter", "s_curve"])


def stations(half_m: float, n: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.linspace(-half_m, half_m, n, dtype=dtype)


def test_without_bends_the_line_is_the_x_axis() -> None:
    line = ReferenceLine([Bend(0.0, 10.0, 0.0)])
    assert line.is_straight
    sigma, d = torch.tensor([-7.0, 300.0]), torch.tensor([1.0, -2.0])
    assert line.place(sigma, d) == (sigma, d)
    assert line.project(sigma, d) == (sigma, d)
    x, y, heading = line.pose(sigma)
    assert (x.tolist(), y.tolist(), heading.tolist()) == ([-7.0, 300.0], [0.0, 0.0], [0.0, 0.0])


@bent
def test_the_origin_is_the_corridors_middle(bends: list[Bend]) -> None:
    x, y, heading = ReferenceLine(bends).pose(torch.zeros(()))
    assert (float(x), float(y), float(heading)) == pytest.approx((0, 0, 0), abs=1e-6)


def test_a_quarter_turn_by_hand() -> None:
    # symmetric about 0: seen from the middle the legs point 45 deg down and up, at equal distance
    length = 40.0
    line = ReferenceLine([Bend(-length / 2, length, 90.0)])
    x, y, heading = line.pose(torch.tensor([-60.0, -20.0, 20.0, 60.0], dtype=torch.float64))
    assert heading.tolist() == pytest.approx([-math.pi / 4] * 2 + [math.pi / 4] * 2)
    assert (x + x.flip(0)).tolist() == pytest.approx([0.0] * 4, abs=1e-9)
    assert (y - y.flip(0)).tolist() == pytest.approx([0.0] * 4, abs=1e-9)
    assert float(x[3] - x[2]) == pytest.approx(40 / math.sqrt(2))
    assert float(y[3] - y[2]) == pytest.approx(40 / math.sqrt(2))
    kappa, kappa_prime = line.curvature(torch.zeros(()))
    assert float(kappa) == pytest.approx(SHARPEST * math.pi / 2 / length)
    assert float(kappa_prime) == pytest.approx(0.0, abs=1e-7)
    # by Simpson's rule on cos(heading) over the half bend, heading = pi/2 (step(u) - 1/2)
    u = torch.linspace(0.5, 1, 2001, dtype=torch.float64)
    cos = torch.cos(math.pi / 2 * (u**3 * (10 - 15 * u + 6 * u * u) - 0.5))
    simpson = float(cos[0] + cos[-1] + 4 * cos[1::2].sum() + 2 * cos[2:-1:2].sum()) / 6000 * length / 2
    assert float(x[2]) == pytest.approx(simpson, abs=1e-9)


@bent
def test_heading_and_curvature_are_derivatives(bends: list[Bend]) -> None:
    line, step = ReferenceLine(bends), 1e-4
    sigma = stations(70.0, 997)
    (x0, y0, h0), (x1, y1, h1) = line.pose(sigma - step), line.pose(sigma + step)
    heading = line.heading(sigma)
    # 1e-4: pose integrates a piece across a bend's end with an error of some 1e-9 m, here divided by 2e-4 m
    torch.testing.assert_close((x1 - x0) / (2 * step), torch.cos(heading), atol=1e-4, rtol=0)
    torch.testing.assert_close((y1 - y0) / (2 * step), torch.sin(heading), atol=1e-4, rtol=0)
    kappa, kappa_prime = line.curvature(sigma)
    torch.testing.assert_close((h1 - h0) / (2 * step), kappa, atol=1e-7, rtol=0)
    rate = (line.curvature(sigma + step)[0] - line.curvature(sigma - step)[0]) / (2 * step)
    torch.testing.assert_close(rate, kappa_prime, atol=1e-6, rtol=0)


@bent
@pytest.mark.parametrize("half_m", [80.0, 500.0])
def test_there_and_back(bends: list[Bend], half_m: float) -> None:
    line = ReferenceLine(bends)
    sigma = stations(half_m, 1601, torch.float32)[:, None].expand(-1, 9)
    d = stations(4.0, 9, torch.float32).expand(1601, 9)
    back, offset = line.project(*line.place(sigma, d))
    # coordinates of 500 m carry roundings of 3e-5 m
    tolerance = 1e-4 if half_m < 100 else 2e-3
    torch.testing.assert_close(back, sigma, atol=tolerance, rtol=0)
    torch.testing.assert_close(offset, d, atol=tolerance, rtol=0)


@settings(max_examples=40, deadline=None)
@given(
    start=st.floats(-60, 30),
    radius=st.floats(20, 200),
    angle=st.floats(5, 80),
    side=st.sampled_from([-1.0, 1.0]),
    sigma=st.floats(-80, 80),
    d=st.floats(-4, 4),
)
def test_there_and_back_on_any_bend(
    start: float, radius: float, angle: float, side: float, sigma: float, d: float
) -> None:
    bend = bend_of_radius(start, radius, side * angle)
    if start + bend.length_m > REACH_M:
        bend = Bend(start, REACH_M - start, bend.angle_deg)
    line = ReferenceLine([bend])
    place = torch.tensor([sigma, d], dtype=torch.float32)
    back = torch.stack(line.project(*line.place(*place)))
    torch.testing.assert_close(back, place, atol=1e-4, rtol=0)


def test_left_is_positive() -> None:
    line = ReferenceLine(QUARTER)
    for sigma in (-50.0, 0.0, 50.0):
        x, y, heading = line.pose(torch.tensor(sigma))
        _, d = line.project(x - torch.sin(heading), y + torch.cos(heading))
        assert float(d) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    ("bends", "line"),
    [
        ([Bend(190.0, 20.0, 10.0)], "bends must lie within 200 m from the corridor, got 190 to 210"),
        ([Bend(0.0, 10.0, 90.0)], "bends must have a radius of at least width_m 7, got 3.4"),
        ([Bend(-80.0, 80.0, 100.0), Bend(0.0, 80.0, 100.0)], "bends must turn by less than 180 deg"),
    ],
)
def test_impossible_bends_are_refused(bends: list[Bend], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        check_bends(bends, width_m=7.0)


def test_bends_that_add_up_are_too_sharp() -> None:
    bend = Bend(0.0, 20.0, 50.0)  # a radius of 12 m, together 6 m
    check_bends([bend], width_m=7.0)
    with pytest.raises(ValueError, match="radius"):
        check_bends([bend, bend], width_m=7.0)
