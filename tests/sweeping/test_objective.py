"""What a sweep is about: the mean of some numbers, or nothing."""

from typing import Any

import pytest

from negopipe.sweeping.objective import objective

METRICS = {"evaluation": {"push": {"adaptive": {"reward": -6.0}}, "yield": {"adaptive": {"reward": -9}}}, "n": None}
PUSH, YIELD = (f"evaluation.{setting}.adaptive.reward" for setting in ("push", "yield"))


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        ([PUSH], -6.0),
        ([PUSH, YIELD], -7.5),
        ([PUSH, "evaluation.rest.adaptive.reward"], None),
        ([PUSH, "n"], None),
        (["evaluation.push"], None),
        ([f"{PUSH}.more"], None),
        ([], None),
    ],
)
def test_it_is_the_mean_of_all_keys_or_nothing(keys: list[str], value: float | None) -> None:
    assert objective(METRICS, keys) == value


@pytest.mark.parametrize("value", [None, "3", True, [1.0], float("nan"), float("inf")])
def test_only_finite_numbers_count(value: Any) -> None:
    assert objective({"a": value}, ["a"]) is None
