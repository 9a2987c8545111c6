"""Estimates with confidence intervals over evaluated episodes and over training seeds.

The bootstrap intervals are percentile intervals (Efron and Tibshirani 1993, ch. 13). They are defined where all
observations are equal, where the bias-corrected interval (BCa) is not. They cover the randomness of the units that
are resampled and no other. The interval of a single observation is NaN.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # whose parts are imported where they are first used, half a second later than the rest

CONFIDENCE = 0.95
"""Probability with which an interval is meant to contain the quantity."""
N_RESAMPLES = 10_000
"""Bootstrap samples per interval."""
BATCH_VALUES = 1_000_000
"""Values that the bootstrap holds at a time, 8 MB per array."""


@dataclass(frozen=True)
class Estimate:
    """A quantity and its confidence interval, all in the unit of the quantity.

    value: computed from all observations
    low, high: bounds of the interval; both NaN where there are too few observations to give one
    """

    value: float
    low: float
    high: float


def rate(is_hit: np.ndarray) -> Estimate:
    """Share of hits in is_hit [N] bool, with its score interval (Wilson 1927).

    The interval lies in 0..1 and keeps a width where there are 0 or N hits.

    Raises ValueError if is_hit is empty or not [N] bool.
    """
    if is_hit.ndim != 1 or is_hit.dtype != np.bool_ or len(is_hit) == 0:
        raise ValueError(f"is_hit must be [N] bool with N > 0, got {list(is_hit.shape)} {is_hit.dtype}")
    test = scipy.stats.binomtest(int(is_hit.sum()), len(is_hit))
    interval = test.proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(float(test.statistic), float(interval.low), float(interval.high))


def mean_difference(a: np.ndarray, b: np.ndarray, rng: np.random.Generator) -> Estimate:
    """Mean of a - b over the same N tasks, with a bootstrap interval that resamples tasks, a and b together.

    a, b: [N] numbers or bool in one unit, entry i of both is task i

    Equal differences give an interval of zero width, so agreement on a few tasks does not show that two planners
    are equal. One task has NaN bounds.

    Raises ValueError if the lengths differ, or if a or b is empty, not one-dimensional or not finite.
    """
    a, b = _checked_pair(a, b)
    return _bootstrap([a - b], np.mean, rng)


def difference_of_means(a: np.ndarray, b: np.ndarray, rng: np.random.Generator) -> Estimate:
    """Mean of a minus mean of b, over different tasks; the bootstrap resamples each on its own.

    a: [N], b: [M] numbers or bool in one unit

    Raises ValueError if a or b is empty, not one-dimensional or not finite.
    """
    return _bootstrap([_checked("a", a), _checked("b", b)], _mean_less_mean, rng)


def spread_difference(a: np.ndarray, b: np.ndarray, rng: np.random.Generator) -> Estimate:
    """Standard deviation of a minus that of b over the same N tasks; the bootstrap resamples tasks, a and b together.

    a, b: [N] numbers in one unit, entry i of both is task i

    Raises ValueError if the lengths differ, or if a or b is empty, not one-dimensional or not finite.
    """
    a, b = _checked_pair(a, b)
    return _bootstrap([a, b], lambda a, b, axis: a.std(axis) - b.std(axis), rng, is_paired=True)


def interquartile_mean(scores: np.ndarray, rng: np.random.Generator) -> Estimate:
    """Mean of the scores without the lowest and the highest quarter (Agarwal et al. 2021, Sec. 4).

    scores: [S] numbers in one unit, one per training seed. Quarters are rounded down: under 4 scores nothing is cut.

    The interval covers the randomness of training alone, not that of the evaluated tasks. It never leaves the
    range of the observed scores, and with few seeds it is too narrow: of normal scores, intervals meant for 95 %
    contain the truth in about 75 % of the cases with 3 seeds, 90 % with 5 and 94 % with 10. One seed has NaN bounds.

    Raises ValueError if scores are empty, not one-dimensional or not finite.
    """
    return _bootstrap([_checked("scores", scores)], _interquartile_mean, rng)


def probability_of_improvement(a: np.ndarray, b: np.ndarray, rng: np.random.Generator) -> Estimate:
    """Share of pairs of runs, one of a and one of b, in which a scores higher; ties count half.

    Mann-Whitney U / (S S') (Agarwal et al. 2021, Sec. 4), with a bootstrap interval that resamples the runs of
    a and those of b on their own. Like that of `interquartile_mean` it is too narrow with few runs, and it has
    zero width where every run of one is above every run of the other. One run of a or b has NaN bounds.

    a: [S], b: [S'] numbers in one unit, higher is better, one score per run

    Raises ValueError if a or b is empty, not one-dimensional or not finite.
    """
    return _bootstrap([_checked("a", a), _checked("b", b)], _share_of_wins, rng)


def _checked(name: str, values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"{name} must be of dimension 1 and not empty, got shape {list(values.shape)}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite, got {int((~np.isfinite(values)).sum())} NaN or infinite values")
    return values


def _checked_pair(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b = _checked("a", a), _checked("b", b)
    if len(a) != len(b):
        raise ValueError(f"a and b must be over the same tasks, got {len(a)} and {len(b)}")
    return a, b


def _bootstrap(
    samples: list[np.ndarray],
    statistic: Callable[..., np.ndarray],
    rng: np.random.Generator,
    *,
    is_paired: bool = False,
) -> Estimate:
    """The statistic of the samples [N_i], resampled each on its own, or together if they are paired."""
    value = float(statistic(*samples, axis=-1))
    if min(map(len, samples)) == 1:
        return Estimate(value, np.nan, np.nan)
    interval = scipy.stats.bootstrap(
        samples,
        statistic,
        n_resamples=N_RESAMPLES,
        batch=max(1, BATCH_VALUES // sum(map(len, samples))),
        vectorized=True,
        paired=is_paired,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=rng,
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))


def _mean_less_mean(a: np.ndarray, b: np.ndarray, axis: int) -> np.ndarray:
    return a.mean(axis) - b.mean(axis)


def _interquartile_mean(scores: np.ndarray, axis: int) -> np.ndarray:
    return scipy.stats.trim_mean(scores, 0.25, axis)


def _share_of_wins(a: np.ndarray, b: np.ndarray, axis: int) -> np.ndarray:
    """U / (S S') with U = R - S (S + 1) / 2, R the sum of the ranks of a among both (Mann and Whitney 1947)."""
    n_a, n_b = a.shape[axis], b.shape[axis]
    rank = scipy.stats.rankdata(np.concatenate([a, b], axis), axis=axis)
    u = np.take(rank, np.arange(n_a), axis).sum(axis) - n_a * (n_a + 1) / 2
    return u / (n_a * n_b)
