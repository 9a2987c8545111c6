"""The smooth step of routes and bends, of tensors and of NumPy arrays alike."""

from typing import Any


def smoothstep(x: Any) -> tuple[Any, Any, Any]:
    """Jerk-optimal step 10x^3 - 15x^4 + 6x^5 from 0 to 1 on [0, 1], constant outside, and two derivatives.

    x: [...] tensor or array
    """
    x = x.clip(0, 1)
    return _step(x), _slope(x), 60 * x * (1 - x) * (1 - 2 * x)


def step(x: Any) -> Any:
    """The value of `smoothstep` alone."""
    return _step(x.clip(0, 1))


def slope(x: Any) -> Any:
    """The first derivative of `smoothstep` alone."""
    return _slope(x.clip(0, 1))


def _step(x: Any) -> Any:
    return x * x * x * (10 + x * (6 * x - 15))


def _slope(x: Any) -> Any:
    return 30 * x * x * (1 - x) * (1 - x)
