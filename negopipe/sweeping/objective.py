"""What a sweep is about: one number per run, made of the numbers in its metrics.json."""

import math
from collections.abc import Mapping, Sequence
from typing import Any


def objective(metrics: Mapping[str, Any], keys: Sequence[str]) -> float | None:
    """Mean of the numbers that `keys` lead to; None where one is missing or is no finite number.

    metrics: what metrics.json holds
    keys: dotted, such as `evaluation.push.adaptive.reward`
    """
    values = [_number(metrics, key) for key in keys]
    numbers = [value for value in values if value is not None]
    return sum(numbers) / len(numbers) if numbers and len(numbers) == len(values) else None


def _number(metrics: Mapping[str, Any], key: str) -> float | None:
    node: Any = metrics
    for part in key.split("."):
        node = node.get(part) if isinstance(node, Mapping) else None
    is_number = isinstance(node, int | float) and not isinstance(node, bool) and math.isfinite(node)
    return float(node) if is_number else None
