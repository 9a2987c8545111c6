"""Estimates against values worked out by hand, and intervals against what they promise."""

import itertools
import math
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from negopipe.evaluation import statistics
from negopipe.evaluation.statistics import (
    Estimate,
    interquartile_mean,
    mean_difference,
    probability_of_improvement,
    rate,
)

BOOTSTRAPS: dict[str, Callable[..., Estimate]] = {
    "mean_difference": lambda scores, rng: mean_difference(scores, np.zeros(len(scores)), rng),
    "interquartile_mean": interquartile_mean,
    "probability_of_improvement": lambda scores, rng: probability_of_improvement(scores, np.array([0.0, 1.0]), rng),
}
"""Every function with a bootstrap interval, as a function of one array of scores [S]."""


@pytest.fixture
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of many intervals."""
    monkeypatch.setattr(statistics, "N_RESAMPLES", 200)


def make_rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def share_containing(truth: float, estimates: list[Estimate]) -> float:
    return float(np.mean([estimate.low <= truth <= estimate.high for estimate in estimates]))


@pytest.mark.parametrize(
    ("n_hits", "n", "low", "high"),
    [
        (9, 10, 0.5958, 0.9821),
        (50, 100, 0.4038, 0.5962),
        (0, 5, 0.0, 0.4345),  # z^2 / (n + z^2)
        (5, 5, 0.5655, 1.0),
        (1, 1, 0.2065, 1.0),
    ],
)
def test_rate_has_the_wilson_interval(n_hits: int, n: int, low: float, high: float) -> None:
    estimate = rate(np.arange(n) < n_hits)
    assert estimate.value == n_hits / n
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-4)


def test_mean_difference_of_two_tasks() -> None:
    # differences 0 and 1: resampled means are 0, 1/2, 1 with probabilities 1/4, 1/2, 1/4
    a, b = np.array([3.0, 5.0]), np.array([3.0, 4.0])
    assert mean_difference(a, b, make_rng()) == Estimate(0.5, 0.0, 1.0)


def test_mean_difference_is_paired() -> None:
    difficulty = 1000 * make_rng(1).integers(0, 9, size=50)
    gain = make_rng(2).integers(-1, 4, size=50)
    paired = mean_difference(difficulty + gain, difficulty, make_rng())
    assert paired == mean_difference(gain, np.zeros(50), make_rng())
    assert paired.high - paired.low < 2


def test_mean_difference_of_outcomes() -> None:
    a, b = np.array([True, True, False, True]), np.array([True, False, True, False])
    assert mean_difference(a, b, make_rng()).value == 0.25


@pytest.mark.filterwarnings("error")
def test_equal_differences_give_an_interval_of_zero_width() -> None:
    b = np.arange(40.0)
    assert mean_difference(b + 3, b, make_rng()) == Estimate(3.0, 3.0, 3.0)


@pytest.mark.usefixtures("few_resamples")
@pytest.mark.parametrize("is_outcome", [False, True])
def test_mean_difference_interval_covers_the_truth(is_outcome: bool) -> None:
    a = make_rng(3).normal(size=(300, 60))
    b = make_rng(4).normal(size=(300, 60))
    rng = make_rng()
    pairs = zip(a > 0, b > 0, strict=True) if is_outcome else zip(a, b, strict=True)
    estimates = [mean_difference(a_tasks, b_tasks, rng) for a_tasks, b_tasks in pairs]
    assert share_containing(0.0, estimates) == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize(
    ("scores", "value"),
    [
        ([1, 2, 3, 4, 5, 6, 9, 100], 4.5),  # 3, 4, 5, 6
        ([9, 100, 1, 6, 4, 2, 5, 3], 4.5),
        ([-50, 1, 2, 6, 100], 3.0),  # a quarter of 5 is rounded down to 1
        ([0, 0, 9], 3.0),  # nothing is cut
    ],
)
def test_interquartile_mean(scores: list[float], value: float) -> None:
    assert interquartile_mean(np.array(scores), make_rng()).value == pytest.approx(value)


@pytest.mark.usefixtures("few_resamples")
@pytest.mark.parametrize(("n_seeds", "coverage"), [(3, 0.75), (5, 0.90), (10, 0.94)])
def test_coverage_of_the_interquartile_mean_is_as_documented(n_seeds: int, coverage: float) -> None:
    rng = make_rng()
    estimates = [interquartile_mean(row, rng) for row in make_rng(3).normal(size=(200, n_seeds))]
    assert share_containing(0.0, estimates) == pytest.approx(coverage, abs=0.06)


@pytest.mark.parametrize(
    ("a", "b", "value"),
    [
        ([1, 2, 3], [0, 0.5], 1.0),
        ([0, 0], [1, 2, 3], 0.0),
        ([1, 3], [2, 2], 0.5),
        ([1, 2, 5], [2, 4], 5 / 12),  # 2.5 of 6 pairs: the tie counts half
        ([7, 7], [7, 7, 7], 0.5),
    ],
)
def test_probability_of_improvement(a: list[float], b: list[float], value: float) -> None:
    assert probability_of_improvement(np.array(a), np.array(b), make_rng()).value == pytest.approx(value)


def test_probability_of_improvement_equals_the_loop_over_pairs() -> None:
    a, b = make_rng(1).integers(0, 6, size=9), make_rng(2).integers(0, 6, size=7)
    wins = [(x > y) + (x == y) / 2 for x, y in itertools.product(a, b)]
    assert probability_of_improvement(a, b, make_rng()).value == pytest.approx(float(np.mean(wins)))
    assert probability_of_improvement(b, a, make_rng()).value == pytest.approx(1 - float(np.mean(wins)))


def test_probability_of_improvement_of_two_runs() -> None:
    # resamples of a: (0, 0), (0, 2) in either order, (2, 2); they win 0, 1/2, 1 of the pairs
    a, b = np.array([0.0, 2.0]), np.array([1.0, 1.0])
    assert probability_of_improvement(a, b, make_rng()) == Estimate(0.5, 0.0, 1.0)


@pytest.mark.usefixtures("few_resamples")
@pytest.mark.parametrize("name", BOOTSTRAPS)
@pytest.mark.parametrize("n", [2, 5, 30])
def test_interval_contains_the_value(name: str, n: int) -> None:
    rng = make_rng()
    for scores in make_rng(n).gamma(0.5, size=(10, n)):
        estimate = BOOTSTRAPS[name](scores, rng)
        assert estimate.low <= estimate.value <= estimate.high


@pytest.mark.parametrize("name", BOOTSTRAPS)
def test_same_seed_same_numbers(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "N_RESAMPLES", 20)  # with many, bounds of a few equal values may agree
    scores = make_rng(5).normal(size=12)
    first, again, other = (BOOTSTRAPS[name](scores, make_rng(seed)) for seed in (1, 1, 2))
    assert first == again
    assert first != other


@pytest.mark.parametrize("name", BOOTSTRAPS)
def test_one_observation_has_no_interval(name: str) -> None:
    estimate = BOOTSTRAPS[name](np.array([2.0]), make_rng())
    assert estimate.value == (1.0 if name == "probability_of_improvement" else 2.0)
    assert math.isnan(estimate.low)
    assert math.isnan(estimate.high)


def test_memory_is_bounded() -> None:
    a, b = make_rng(1).normal(size=(2, 10_000))
    tracemalloc.start()
    mean_difference(a, b, make_rng())  # 800 MB per array if all were held at once
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 40e6


@pytest.mark.parametrize(
    "is_hit", [np.zeros(0, bool), np.array([0.0, 1.0]), np.array([0, 1]), np.zeros((2, 2), bool), np.array(True)]
)
def test_rate_refuses_what_is_not_a_row_of_hits(is_hit: np.ndarray) -> None:
    with pytest.raises(ValueError, match="is_hit must be"):
        rate(is_hit)


def test_mean_difference_refuses_different_lengths() -> None:
    with pytest.raises(ValueError, match="same tasks, got 3 and 1"):
        mean_difference(np.zeros(3), np.zeros(1), make_rng())


@pytest.mark.parametrize("function", [mean_difference, probability_of_improvement])
@pytest.mark.parametrize("bad", [np.zeros(0), np.zeros((2, 2)), np.array([1.0, np.nan]), np.array([np.inf, 0.0])])
def test_two_samples_refuse_bad_values(function: Callable[..., Estimate], bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="a must"):
        function(bad, np.zeros(2), make_rng())
    with pytest.raises(ValueError, match="b must"):
        function(np.zeros(2), bad, make_rng())


@pytest.mark.parametrize(
    "bad", [np.zeros(0), np.zeros((0, 3)), np.zeros((2, 2)), np.float64(1.0), np.array([1.0, np.nan])]
)
def test_interquartile_mean_refuses_bad_values(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="scores must"):
        interquartile_mean(bad, make_rng())
