import numpy as np
import pytest
import scipy.stats

from twirl_mjx.figures import statistics
from twirl_mjx.figures.statistics import iqm

RNG = np.random.default_rng(7)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 8, 11, 100])
def test_iqm_is_scipys_trimmed_mean(size):
    samples = RNG.normal(size=(6, size))
    np.testing.assert_allclose(iqm(samples), scipy.stats.trim_mean(samples, 0.25, axis=-1))
    np.testing.assert_allclose(iqm(samples.T, axis=0), iqm(samples))


def test_iqm_ignores_the_outer_quarters():
    assert iqm(np.array([-1e9, 1.0, 2.0, 1e9])) == 1.5


def test_plain_statistics():
    samples = np.array([1.0, 2.0, 6.0])
    assert statistics.mean(samples) == 3.0
    assert statistics.median(samples) == 2.0
    assert statistics.std(samples) == pytest.approx(np.sqrt(7.0))
    assert np.isnan(statistics.std(np.array([1.0])))
    with pytest.raises(ValueError, match="no samples"):
        statistics.mean(np.empty((3, 0)))


def test_bootstrap_agrees_with_scipy():
    samples = RNG.gamma(2.0, size=30)
    ours = statistics.bootstrap([samples], resamples=20_000)
    theirs = scipy.stats.bootstrap(
        (samples,), iqm, n_resamples=20_000, method="percentile", vectorized=True, rng=1
    ).confidence_interval
    assert ours.estimate == iqm(samples)
    width = theirs.high - theirs.low
    assert ours.low == pytest.approx(theirs.low, abs=0.03 * width)
    assert ours.high == pytest.approx(theirs.high, abs=0.03 * width)


def test_stratified_bootstrap_agrees_with_scipy():
    a, b = RNG.normal(0, 1, size=12), RNG.normal(10, 2, size=20)

    def pooled(x, y, axis=-1):
        return iqm(np.concatenate([x, y], axis=axis), axis=axis)

    ours = statistics.bootstrap([a, b], resamples=20_000)
    theirs = scipy.stats.bootstrap(
        (a, b), pooled, n_resamples=20_000, method="percentile", vectorized=True, rng=1
    ).confidence_interval
    width = theirs.high - theirs.low
    assert ours.low == pytest.approx(theirs.low, abs=0.04 * width)
    assert ours.high == pytest.approx(theirs.high, abs=0.04 * width)
    mixed = statistics.bootstrap([np.concatenate([a, b])], resamples=5_000)
    assert mixed.high - mixed.low > 1.5 * width  # without strata the two levels mix


def test_bootstrap_interval_covers_the_truth_about_as_often_as_it_says():
    covered = 0
    for trial in range(200):
        samples = np.random.default_rng(trial).normal(5.0, 1.0, size=40)
        interval = statistics.bootstrap([samples], statistics.mean, resamples=400, seed=trial)
        covered += interval.low <= 5.0 <= interval.high
    assert 0.90 <= covered / 200 <= 0.985


def test_the_seed_fixes_the_interval():
    samples = [RNG.normal(size=9)]
    first = statistics.bootstrap(samples, seed=3)
    assert statistics.bootstrap(samples, seed=3) == first
    assert statistics.bootstrap(samples, seed=4) != first


def test_bootstrap_band_is_the_pointwise_bootstrap():
    curves = RNG.normal(size=(6, 4)).cumsum(axis=1)
    low, high = statistics.bootstrap_band(curves, resamples=500, seed=2)
    for t in range(4):
        point = statistics.bootstrap([curves[:, t]], resamples=500, seed=2)
        assert (low[t], high[t]) == (point.low, point.high)


def test_one_sample_has_no_interval():
    interval = statistics.bootstrap([np.array([4.0])])
    assert interval.estimate == 4.0
    assert np.isnan([interval.low, interval.high]).all()
    assert np.isnan(statistics.bootstrap([np.arange(5.0), np.array([4.0])]).low)
    assert np.isnan(statistics.bootstrap_band(np.ones((1, 3)))).all()
    assert np.isnan(statistics.ratio(np.array([4.0]), np.arange(1.0, 4.0)).low)
    single = statistics.probability_of_improvement([np.array([1.0])], [np.array([0.0])])
    assert single.estimate == 1.0
    assert np.isnan(single.low)


def test_probability_of_improvement_is_mann_whitney():
    x, y = RNG.integers(0, 6, size=14).astype(float), RNG.integers(0, 5, size=9).astype(float)
    u = float(scipy.stats.mannwhitneyu(x, y)[0])  # pyright: ignore
    expected = u / (len(x) * len(y))
    interval = statistics.probability_of_improvement([x], [y])
    assert interval.estimate == pytest.approx(expected)
    assert interval.low < expected < interval.high


def test_probability_of_improvement_counts_ties_half_and_averages_strata():
    same = [np.array([1.0, 1.0])]
    assert statistics.probability_of_improvement(same, same).estimate == 0.5
    above = [np.array([2.0, 3.0])]
    both = statistics.probability_of_improvement([*same, *above], [*same, *same])
    assert both.estimate == 0.75


def test_probability_interval_agrees_with_scipy():
    x, y = RNG.normal(0.7, 1, size=15), RNG.normal(0, 1, size=12)

    def probability(a, b, axis=-1):
        return (a[..., :, None] > b[..., None, :]).mean(axis=(-1, -2))

    ours = statistics.probability_of_improvement([x], [y], resamples=20_000)
    theirs = scipy.stats.bootstrap(
        (x, y), probability, n_resamples=5_000, method="percentile", vectorized=True, rng=1
    ).confidence_interval
    assert ours.low == pytest.approx(theirs.low, abs=0.02)
    assert ours.high == pytest.approx(theirs.high, abs=0.02)


def test_ratio_by_hand_and_its_limits():
    interval = statistics.ratio(np.array([4.0, 6.0]), np.array([2.0, 2.0]))
    assert (interval.estimate, interval.low, interval.high) == (2.5, 2.0, 3.0)
    below = statistics.ratio(np.array([4.0, 6.0]), np.array([-1.0, -2.0]))
    assert np.isnan([below.estimate, below.low, below.high]).all()
    unsure = statistics.ratio(np.array([4.0, 6.0]), np.array([-1.0, 3.0]))
    assert unsure.estimate == 5.0
    assert np.isnan(unsure.low)


def test_bad_arguments_are_refused():
    samples = [np.arange(4.0)]
    with pytest.raises(ValueError, match=r"confidence is 95, expected a value in \(0, 1\)"):
        statistics.bootstrap(samples, confidence=95)
    with pytest.raises(ValueError, match="resamples is 0, expected >= 1"):
        statistics.bootstrap(samples, resamples=0)
    with pytest.raises(ValueError, match=r"strata of sizes \[4, 0\]"):
        statistics.bootstrap([*samples, np.array([])])
    with pytest.raises(ValueError, match="a sample is NaN"):
        statistics.bootstrap([np.array([1.0, np.nan])])
    with pytest.raises(ValueError, match="1 strata against 2"):
        statistics.probability_of_improvement(samples, samples * 2)
    with pytest.raises(ValueError, match=r"expected \[S >= 1, T\]"):
        statistics.bootstrap_band(np.arange(4.0))
