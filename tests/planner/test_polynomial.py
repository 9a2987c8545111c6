"""End states of polynomials are exact, and a quintic is what minimises the jerk."""

import pytest
import torch

from negopipe.planner.polynomial import derivative_row, evaluate, quartic, quintic, sampling_rows


@pytest.mark.parametrize("duration", [0.5, 2.0, 6.0])
def test_quintic_meets_its_boundary(duration: float) -> None:
    boundary = torch.tensor([1.0, 4.0, -0.5, 12.0, 2.0, 0.3], dtype=torch.float64)
    c = quintic(duration) @ boundary
    reached = torch.stack([derivative_row(t, order) @ c for t in (0.0, duration) for order in range(3)])
    torch.testing.assert_close(reached, boundary)


def test_quartic_meets_its_boundary() -> None:
    boundary = torch.tensor([1.0, 4.0, -0.5, 2.0, 0.3], dtype=torch.float64)  # p0 v0 a0 v1 a1
    c = quartic(3.0) @ boundary
    reached = [derivative_row(0.0, order) @ c for order in range(3)]
    reached += [derivative_row(3.0, order) @ c for order in (1, 2)]
    torch.testing.assert_close(torch.stack(reached), boundary)
    assert c[5] == 0


def test_quintic_has_the_least_jerk_of_all_that_meet_the_boundary() -> None:
    c = quintic(2.0) @ torch.tensor([0.0, 4.0, 0.0, 5.0, 0.0, 0.0], dtype=torch.float64)
    times = torch.linspace(0, 2, 400, dtype=torch.float64)
    jerk = sampling_rows(times, 2.0, 3) @ c
    # t^3 (2 - t)^3 changes neither end state; its third derivative is added to the jerk
    t = times
    bump = 48 - 288 * t + 360 * t**2 - 120 * t**3
    for share in (-0.1, 0.1):
        assert float((jerk + share * bump).square().mean()) > float(jerk.square().mean())


def test_motion_goes_on_at_end_speed() -> None:
    c = quartic(2.0) @ torch.tensor([0.0, 4.0, 0.0, 3.0, 0.0], dtype=torch.float64)
    times = torch.tensor([2.0, 4.0], dtype=torch.float64)
    at_end, later = (sampling_rows(times, 2.0, 0) @ c).tolist()
    assert later - at_end == pytest.approx(6.0)
    assert (sampling_rows(times, 2.0, 1) @ c).tolist() == pytest.approx([3.0, 3.0])
    assert (sampling_rows(times, 2.0, 2) @ c)[1] == 0


def test_evaluate_agrees_with_rows() -> None:
    c = torch.tensor([1.0, -2.0, 0.5, 0.3, -0.1, 0.02], dtype=torch.float64)
    got = evaluate(tuple(c), torch.tensor(1.7, dtype=torch.float64))
    expected = [derivative_row(1.7, order) @ c for order in range(3)]
    torch.testing.assert_close(torch.stack(got), torch.stack(expected))
