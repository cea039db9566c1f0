"""Statistics for a handful of runs: robust averages with two-level bootstrap intervals.

Runs differ by their seeds and a run's episodes by theirs, so a resample first draws runs, then
episodes within every drawn run (Davison and Hinkley 1997, "Bootstrap Methods", section 3.8);
scipy's bootstrap does not nest. A single run says nothing about other seeds: its interval is over
its episodes only, and says so. A *sample* here is one array per run: its episodes, or the one value
of a curve. Averages are the mean and the interquartile mean (Agarwal et al. 2021, "Deep
reinforcement learning at the edge of the statistical precipice"). Plain numpy with a fixed seed, so
that a figure is the same each time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

RESAMPLES = 2000
"""Bootstrap resamples: a 95 % bound then moves by about 0.05 standard errors between seeds."""
CONFIDENCE = 0.95
"""Probability mass between the two bounds of an interval."""
FEW_RUNS = 5
"""Below so many runs the bounds are close to, and for two or three equal to, their range."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its bootstrap interval."""

    estimate: float
    """The statistic of the samples themselves."""
    low: float
    """Lower bound; NaN where a single value allows no interval."""
    high: float
    """Upper bound; NaN where a single value allows no interval."""
    over: str = ""
    """What was drawn anew: ``runs``, ``runs and episodes``, ``episodes`` (of a single run);
    empty without an interval."""


@dataclass(frozen=True)
class TrimmedMean:
    """The mean without a share of the lowest and as many of the highest samples."""

    share: float
    """Share cut at each end, in [0, 0.5); floor(share * n) samples."""

    def __call__(self, samples: np.ndarray, axis: int = -1) -> np.ndarray:
        """Return the trimmed mean along an axis.

        Raises:
            ValueError: If the axis is empty.
        """
        values = np.sort(_filled(samples, axis), axis=-1)
        cut = int(values.shape[-1] * self.share)
        return values[..., cut : values.shape[-1] - cut].mean(axis=-1)

    def of_counts(self, values: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Return the trimmed mean of every resample, given how often it holds each value.

        Args:
            values: Samples [n].
            counts: Times each was drawn, [R, n].

        Returns:
            One mean per resample, [R].
        """
        order = np.argsort(values, kind="stable")
        total = counts.sum(axis=-1, keepdims=True)
        cut = (total * self.share).astype(np.int64)
        below = np.clip(np.cumsum(counts[:, order], axis=-1), cut, total - cut)
        kept = np.diff(below, axis=-1, prepend=cut)
        return kept @ values[order] / (total - 2 * cut)[:, 0]


mean = TrimmedMean(0.0)
"""The mean along an axis."""
iqm = TrimmedMean(0.25)
"""The interquartile mean, as ``scipy.stats.trim_mean(x, 0.25)``; the mean below four samples."""


def std(samples: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the standard deviation with n - 1 in the denominator; NaN for one sample."""
    values = _filled(samples, axis)
    if values.shape[-1] < 2:
        return np.full(values.shape[:-1], np.nan)
    return values.std(axis=-1, ddof=1)


def bootstrap(
    runs: Sequence[np.ndarray],
    statistic: TrimmedMean = iqm,
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Interval:
    """Return a statistic of all samples with its two-level percentile interval.

    Args:
        runs: Samples [E_k] of every run.
        statistic: What to compute of the pooled samples.
        resamples: Number of resamples.
        confidence: Probability mass of the interval, in (0, 1).
        seed: Seed of the generator.

    Raises:
        ValueError: If there is no run, one is empty, or a number is out of range.
    """
    arrays = _check_runs(runs)
    _check_numbers(resamples, confidence)
    values = np.concatenate(arrays)
    estimate = float(statistic(values))
    if not (over := drawn(arrays)):
        return Interval(estimate, np.nan, np.nan)
    counts = _counts(np.random.default_rng(seed), arrays, resamples)
    return _percentiles(estimate, statistic.of_counts(values, counts), confidence, over)


def bootstrap_band(
    values: np.ndarray,
    statistic: TrimmedMean = iqm,
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return pointwise bootstrap bounds of a statistic over curves.

    Whole curves are drawn, so that a run keeps its own history within a resample.

    Args:
        values: One curve per run, [S, T].
        statistic: What to compute over the runs.
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
    counts = _counts(np.random.default_rng(seed), list(values[:, :1]), resamples)
    tail = 50 * (1 - confidence)
    draws = np.stack([statistic.of_counts(column, counts) for column in values.T])
    low, high = np.percentile(draws, [tail, 100 - tail], axis=-1)
    return low, high


def probability_of_improvement(
    better: Sequence[np.ndarray],
    baseline: Sequence[np.ndarray],
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Interval:
    """Return P(X > Y) + P(X = Y) / 2 for random samples X and Y.

    This is the Mann-Whitney U statistic over n m. In the interval both sides are drawn anew, runs
    first, then episodes.

    Args:
        better: Samples [E_k] of X, one array per run.
        baseline: Samples [F_k] of Y, one array per run.
        resamples: Number of resamples.
        confidence: Probability mass of the interval, in (0, 1).
        seed: Seed of the generator.

    Raises:
        ValueError: If a side has no run, a run is empty, or a number is out of range.
    """
    xs, ys = _check_runs(better), _check_runs(baseline)
    _check_numbers(resamples, confidence)
    x, y = np.concatenate(xs), np.concatenate(ys)
    wins = (x[:, None] > y) + 0.5 * (x[:, None] == y)
    estimate = float(wins.mean())
    if not (over := _both(xs, ys)):
        return Interval(estimate, np.nan, np.nan)
    rng = np.random.default_rng(seed)
    x_counts, y_counts = _counts(rng, xs, resamples), _counts(rng, ys, resamples)
    draws = ((x_counts @ wins) * y_counts).sum(axis=-1)
    draws = draws / (x_counts.sum(axis=-1) * y_counts.sum(axis=-1))
    return _percentiles(estimate, draws, confidence, over)


def ratio(
    runs: Sequence[np.ndarray],
    baseline: Sequence[np.ndarray],
    statistic: TrimmedMean = iqm,
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Interval:
    """Return statistic(runs) / statistic(baseline) with its two-level percentile interval.

    Absolute returns depend on details of a task, ratios less so. A ratio needs a positive
    denominator: where the baseline's statistic is not, the result is NaN; where that of some
    resamples is not, the bounds are NaN.

    Args:
        runs: Samples [E_k], one array per run.
        baseline: Samples [F_k], one array per run, drawn independently of ``runs``.
        statistic: What to compute of the pooled samples of a side.
        resamples: Number of resamples.
        confidence: Probability mass of the interval, in (0, 1).
        seed: Seed of the generator.

    Raises:
        ValueError: If a side has no run, a run is empty, or a number is out of range.
    """
    xs, ys = _check_runs(runs), _check_runs(baseline)
    _check_numbers(resamples, confidence)
    x, y = np.concatenate(xs), np.concatenate(ys)
    below = float(statistic(y))
    if not below > 0:
        return Interval(np.nan, np.nan, np.nan)
    estimate = float(statistic(x)) / below
    if not (over := _both(xs, ys)):
        return Interval(estimate, np.nan, np.nan)
    rng = np.random.default_rng(seed)
    above = statistic.of_counts(x, _counts(rng, xs, resamples))
    under = statistic.of_counts(y, _counts(rng, ys, resamples))
    if not (under > 0).all():
        return Interval(estimate, np.nan, np.nan)
    return _percentiles(estimate, above / under, confidence, over)


def drawn(runs: Sequence[np.ndarray]) -> str:
    """Return what a resample draws anew: runs, episodes, both, or nothing (empty)."""
    parts = ["runs"] if len(runs) > 1 else []
    parts += ["episodes"] if max(len(run) for run in runs) > 1 else []
    return " and ".join(parts)


def _both(xs: Sequence[np.ndarray], ys: Sequence[np.ndarray]) -> str:
    """Return what two sides draw anew: the narrower of the two; empty if one draws nothing."""
    overs = sorted((drawn(xs), drawn(ys)), key=lambda over: ("runs" in over, over))
    return overs[0] if all(overs) else ""


def _filled(samples: np.ndarray, axis: int) -> np.ndarray:
    values = np.moveaxis(np.asarray(samples, np.float64), axis, -1)
    if not values.shape[-1]:
        raise ValueError("no samples along the axis, expected at least one")
    return values


def _check_runs(runs: Sequence[np.ndarray]) -> list[np.ndarray]:
    arrays = [np.asarray(array, np.float64).ravel() for array in runs]
    if not arrays or min(len(array) for array in arrays) < 1:
        sizes = [len(array) for array in arrays]
        raise ValueError(f"runs of sizes {sizes}, expected at least one sample in each")
    if any(np.isnan(array).any() for array in arrays):
        raise ValueError("a sample is NaN; leave unmeasured values out first")
    return arrays


def _check_numbers(resamples: int, confidence: float) -> None:
    if resamples < 1:
        raise ValueError(f"resamples is {resamples}, expected >= 1")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, expected a value in (0, 1), such as 0.95")


def _counts(rng: np.random.Generator, runs: Sequence[np.ndarray], resamples: int) -> np.ndarray:
    """Return how often each pooled sample is drawn: runs first, then samples within each.

    Returns:
        Counts [resamples, sum E_k]: a run that was drawn c times has c E_k samples.
    """
    chosen = rng.integers(len(runs), size=(resamples, len(runs)))
    size = sum(len(run) for run in runs)
    counts = np.zeros(resamples * size, np.int64)
    offset = 0
    for k, run in enumerate(runs):
        draws = (chosen == k).sum(axis=-1) * len(run)
        rows = np.repeat(np.arange(resamples), draws)
        columns = offset + rng.integers(len(run), size=len(rows))
        counts += np.bincount(rows * size + columns, minlength=resamples * size)
        offset += len(run)
    return counts.reshape(resamples, size)


def _percentiles(estimate: float, draws: np.ndarray, confidence: float, over: str) -> Interval:
    tail = 50 * (1 - confidence)
    low, high = np.percentile(draws, [tail, 100 - tail])
    return Interval(estimate, float(low), float(high), over)
