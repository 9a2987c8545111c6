"""The smooth step of routes and bends, of tensors and of NumPy arrays alike."""

from typing import Any


def smoothstep(x: Any) -> tuple[Any, Any, Any]:
    """Jerk-optimal step 10x^3 - 15x^4 + 6x^5 from 0 to 1 on [0, 1], constant outside, and two derivatives.

    x: [...] tensor or array
    """
    x = x.clip(0, 1)
    value = x * x * x * (10 + x * (6 * x - 15))
    first = 30 * x * x * (1 - x) * (1 - x)
    second = 60 * x * (1 - x) * (1 - 2 * x)
    return value, first, second
