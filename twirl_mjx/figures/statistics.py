"""Statistics for a handful of seeds: robust averages with bootstrap intervals.

With three to five runs a mean says little and a standard deviation less, so results carry the
interquartile mean and a 95 % stratified bootstrap interval as well (Agarwal et al. 2021, "Deep
reinforcement learning at the edge of the statistical precipice"). A *stratum* is a set of
exchangeable samples, for example the seeds of one task; resampling never moves a sample from one
stratum to another. Everything is plain numpy with a fixed seed, so a figure is the same each time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

RESAMPLES = 2000
"""Bootstrap resamples: a 95 % bound then moves by about 0.05 standard errors between seeds."""
CONFIDENCE = 0.95
"""Probability mass between the two bounds of an interval."""

Statistic = Callable[..., np.ndarray]
"""Function (samples [..., n], axis=-1) -> [...]."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its bootstrap interval."""

    estimate: float
    """The statistic of the samples themselves."""
    low: float
    """Lower bound; NaN where a single sample allows no interval."""
    high: float
    """Upper bound; NaN where a single sample allows no interval."""


def iqm(samples: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the interquartile mean: the mean without the lowest and highest quarter.

    The number cut at each end is floor(n / 4), as in ``scipy.stats.trim_mean(samples, 0.25)``; so
    fewer than four samples give the mean.

    Args:
        samples: Values [..., n].
        axis: The axis of length n.
    """
    values = np.sort(_filled(samples, axis), axis=-1)
    cut = values.shape[-1] // 4
    return values[..., cut : values.shape[-1] - cut].mean(axis=-1)


def mean(samples: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean along an axis."""
    return _filled(samples, axis).mean(axis=-1)


def median(samples: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the median along an axis."""
    return np.median(_filled(samples, axis), axis=-1)


def std(samples: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the standard deviation with n - 1 in the denominator; NaN for one sample."""
    values = _filled(samples, axis)
    if values.shape[-1] < 2:
        return np.full(values.shape[:-1], np.nan)
    return values.std(axis=-1, ddof=1)


def bootstrap(
    strata: Sequence[np.ndarray],
    statistic: Statistic = iqm,
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Interval:
    """Return a statistic of pooled samples with its stratified percentile interval.

    Args:
        strata: One array [n_k] per stratum; every resample draws n_k of stratum k, with
            replacement.
        statistic: Function of the pooled samples [..., sum n_k] along the last axis.
        resamples: Number of resamples.
        confidence: Probability mass of the interval, in (0, 1).
        seed: Seed of the generator.

    Returns:
        The estimate and its bounds; the bounds are NaN if a stratum has one sample only.

    Raises:
        ValueError: If there is no stratum, one is empty, or a number is out of range.
    """
    arrays = _check_strata(strata)
    _check_numbers(resamples, confidence)
    estimate = float(statistic(np.concatenate(arrays), axis=-1))
    if min(len(array) for array in arrays) < 2:
        return Interval(estimate, np.nan, np.nan)
    rng = np.random.default_rng(seed)
    draws = [array[_draw(rng, resamples, len(array))] for array in arrays]
    return _percentiles(estimate, statistic(np.concatenate(draws, axis=-1), axis=-1), confidence)


def bootstrap_band(
    values: np.ndarray,
    statistic: Statistic = iqm,
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return pointwise bootstrap bounds of a statistic over curves.

    Whole curves are drawn, so that a run keeps its own history within a resample.

    Args:
        values: One curve per run, [S, T].
        statistic: Function of [..., S] along an axis.
        resamples: Number of resamples.
        confidence: Probability mass of the interval, in (0, 1).
        seed: Seed of the generator.

    Returns:
        Lower and upper bound, [T] each; NaN for a single run.

    Raises:
        ValueError: If ``values`` is not two-dimensional or a number is out of range.
    """
    if values.ndim != 2 or not values.shape[0]:
        raise ValueError(f"values have shape {values.shape}, expected [S >= 1, T]")
    _check_numbers(resamples, confidence)
    if values.shape[0] < 2:
        empty = np.full(values.shape[1], np.nan)
        return empty, empty.copy()
    rows = _draw(np.random.default_rng(seed), resamples, values.shape[0])
    tail = 50 * (1 - confidence)
    low, high = np.empty(values.shape[1]), np.empty(values.shape[1])
    for t, column in enumerate(values.T):  # one moment at a time bounds the memory to [R, S]
        low[t], high[t] = np.percentile(statistic(column[rows], axis=-1), [tail, 100 - tail])
    return low, high


def probability_of_improvement(
    better: Sequence[np.ndarray],
    baseline: Sequence[np.ndarray],
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Interval:
    """Return P(X > Y) + P(X = Y) / 2 for random samples X and Y, averaged over strata.

    For one stratum this is the Mann-Whitney U statistic over n m. The interval is a stratified
    percentile bootstrap in which both sides are drawn anew.

    Args:
        better: Samples [n_k] of X, one array per stratum.
        baseline: Samples [m_k] of Y, for the same strata.
        resamples: Number of resamples.
        confidence: Probability mass of the interval, in (0, 1).
        seed: Seed of the generator.

    Raises:
        ValueError: If the two sides differ in their number of strata, a stratum is empty, or a
            number is out of range.
    """
    xs, ys = _check_strata(better), _check_strata(baseline)
    _check_numbers(resamples, confidence)
    if len(xs) != len(ys):
        raise ValueError(f"{len(xs)} strata against {len(ys)}, expected the same strata")
    wins = [_wins(x, y) for x, y in zip(xs, ys, strict=True)]
    estimate = float(np.mean([win.mean() for win in wins]))
    if min(len(array) for array in (*xs, *ys)) < 2:
        return Interval(estimate, np.nan, np.nan)
    rng = np.random.default_rng(seed)
    total = np.zeros(resamples)
    for win in wins:
        x_share = _draw_shares(rng, resamples, win.shape[0])
        y_share = _draw_shares(rng, resamples, win.shape[1])
        total += ((x_share @ win) * y_share).sum(axis=-1)
    return _percentiles(estimate, total / len(wins), confidence)


def ratio(
    samples: np.ndarray,
    baseline: np.ndarray,
    statistic: Statistic = iqm,
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Interval:
    """Return statistic(samples) / statistic(baseline) with its percentile interval.

    Absolute returns depend on details of a task, ratios less so. A ratio needs a positive
    denominator: where the baseline's statistic is not, the result is NaN; where that of some
    resamples is not, the bounds are NaN.

    Args:
        samples: Values [n].
        baseline: Values [m], drawn independently of ``samples``.
        statistic: Function of [..., n] along the last axis.
        resamples: Number of resamples.
        confidence: Probability mass of the interval, in (0, 1).
        seed: Seed of the generator.

    Raises:
        ValueError: If a side is empty or a number is out of range.
    """
    x, y = _check_strata([samples, baseline])
    _check_numbers(resamples, confidence)
    below = float(statistic(y, axis=-1))
    if not below > 0:
        return Interval(np.nan, np.nan, np.nan)
    estimate = float(statistic(x, axis=-1)) / below
    if min(len(x), len(y)) < 2:
        return Interval(estimate, np.nan, np.nan)
    rng = np.random.default_rng(seed)
    above = statistic(x[_draw(rng, resamples, len(x))], axis=-1)
    under = statistic(y[_draw(rng, resamples, len(y))], axis=-1)
    if not (under > 0).all():
        return Interval(estimate, np.nan, np.nan)
    return _percentiles(estimate, above / under, confidence)


def _filled(samples: np.ndarray, axis: int) -> np.ndarray:
    values = np.moveaxis(np.asarray(samples, np.float64), axis, -1)
    if not values.shape[-1]:
        raise ValueError("no samples along the axis, expected at least one")
    return values


def _check_strata(strata: Sequence[np.ndarray]) -> list[np.ndarray]:
    arrays = [np.asarray(array, np.float64).ravel() for array in strata]
    if not arrays or min(len(array) for array in arrays) < 1:
        sizes = [len(array) for array in arrays]
        raise ValueError(f"strata of sizes {sizes}, expected at least one sample in each")
    if any(np.isnan(array).any() for array in arrays):
        raise ValueError("a sample is NaN; leave unmeasured values out first")
    return arrays


def _check_numbers(resamples: int, confidence: float) -> None:
    if resamples < 1:
        raise ValueError(f"resamples is {resamples}, expected >= 1")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, expected a value in (0, 1), such as 0.95")


def _draw(rng: np.random.Generator, resamples: int, size: int) -> np.ndarray:
    return rng.integers(size, size=(resamples, size))


def _draw_shares(rng: np.random.Generator, resamples: int, size: int) -> np.ndarray:
    """Return how often each sample is drawn, as a share: [resamples, size], rows sum to 1."""
    return rng.multinomial(size, np.full(size, 1 / size), size=resamples) / size


def _wins(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (x[:, None] > y) + 0.5 * (x[:, None] == y)


def _percentiles(estimate: float, draws: np.ndarray, confidence: float) -> Interval:
    tail = 50 * (1 - confidence)
    low, high = np.percentile(draws, [tail, 100 - tail])
    return Interval(estimate, float(low), float(high))
