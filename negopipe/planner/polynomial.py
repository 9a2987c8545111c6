"""Jerk-optimal polynomials as linear maps (Werling 2010, Sec. III).

A quintic is the jerk-optimal connection of two full states (position, velocity, acceleration); where the end
position is free, it is a quartic. For a fixed duration the coefficients are linear in the boundary values, so a
set of candidates with fixed durations is one matrix. It is computed once, and one matrix product samples every
candidate of every vehicle.
"""

import torch
from torch import Tensor

N_COEFFICIENTS = 6
"""Every polynomial is stored as c_0 .. c_5; a quartic has c_5 = 0."""


def derivative_row(t: float, order: int) -> Tensor:
    """[6] float64: row r, for which r @ c is the `order`-th derivative of sum_k c_k t^k at t."""
    row = torch.zeros(N_COEFFICIENTS, dtype=torch.float64)
    for power in range(order, N_COEFFICIENTS):
        factor = 1.0
        for k in range(order):
            factor *= power - k
        row[power] = factor * t ** (power - order)
    return row


def quintic(duration: float) -> Tensor:
    """[6, 6] float64: boundary values (p0, v0, a0, p1, v1, a1) -> coefficients of the quintic on [0, duration]."""
    rows = [derivative_row(t, order) for t in (0.0, duration) for order in range(3)]
    return torch.linalg.inv(torch.stack(rows))


def quartic(duration: float) -> Tensor:
    """[6, 5] float64: boundary values (p0, v0, a0, v1, a1), free end position -> coefficients of the quartic."""
    rows = [derivative_row(0.0, order) for order in range(3)]
    rows += [derivative_row(duration, order) for order in (1, 2)]
    without_fifth = torch.stack(rows)[:, : N_COEFFICIENTS - 1]
    return torch.cat([torch.linalg.inv(without_fifth), torch.zeros(1, 5, dtype=torch.float64)])


def sampling_rows(times: Tensor, duration: float, order: int) -> Tensor:
    """[T, 6] float64: coefficients -> `order`-th derivative (0 to 3) at `times` [T].

    After the duration the motion continues at the end velocity.
    """
    rows = []
    for t in times.tolist():
        if t <= duration:
            rows.append(derivative_row(t, order))
        elif order == 0:
            rows.append(derivative_row(duration, 0) + (t - duration) * derivative_row(duration, 1))
        else:
            rows.append(derivative_row(duration, order) * (order == 1))
    return torch.stack(rows)


def evaluate(coefficients: tuple[Tensor, ...], x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Value, first and second derivative at x [...] of the polynomials with coefficients c_0 .. c_5, each [...]."""
    c0, c1, c2, c3, c4, c5 = coefficients
    value = c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))
    first = c1 + x * (2 * c2 + x * (3 * c3 + x * (4 * c4 + x * 5 * c5)))
    second = 2 * c2 + x * (6 * c3 + x * (12 * c4 + x * 20 * c5))
    return value, first, second
