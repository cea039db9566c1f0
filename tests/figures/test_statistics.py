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
    assert statistics.std(samples) == pytest.approx(np.sqrt(7.0))
    assert np.isnan(statistics.std(np.array([1.0])))
    with pytest.raises(ValueError, match="no samples"):
        statistics.mean(np.empty((3, 0)))


def single(values):
    """Runs of one value each, as of curves."""
    return [np.array([value]) for value in values]


def test_bootstrap_of_one_level_agrees_with_scipy():
    samples = RNG.gamma(2.0, size=30)
    theirs = scipy.stats.bootstrap(
        (samples,), iqm, n_resamples=20_000, method="percentile", vectorized=True, rng=1
    ).confidence_interval
    width = theirs.high - theirs.low
    for runs, over in ((single(samples), "runs"), ([samples], "episodes")):
        ours = statistics.bootstrap(runs, resamples=20_000)
        assert (ours.estimate, ours.over) == (iqm(samples), over)
        assert ours.low == pytest.approx(theirs.low, abs=0.03 * width)
        assert ours.high == pytest.approx(theirs.high, abs=0.03 * width)


def test_two_levels_by_hand():
    """Runs {0, 0} and {6, 18}: the mean of a resample is 0 when the first is drawn twice.

    With probability 1/4 the first run is drawn twice (0), with 1/4 the second twice (four
    episodes of 6 or 18: 6 + 3 k with k of 4 right), with 1/2 both (two episodes: 3, 6 or 9).
    """
    runs = [np.array([0.0, 0.0]), np.array([6.0, 18.0])]
    probability = {0.0: 1 / 4}
    for k, ways in enumerate((1, 2, 1)):
        probability[3.0 + 3.0 * k] = ways / 8
    for k, ways in enumerate((1, 4, 6, 4, 1)):
        value = 6.0 + 3.0 * k
        probability[value] = probability.get(value, 0.0) + ways / 64
    counts = statistics._counts(np.random.default_rng(0), runs, 64_000)
    assert set(counts.sum(axis=1)) == {4}
    means = statistics.mean.of_counts(np.concatenate(runs), counts)
    assert set(means) == set(probability)
    for value, share in probability.items():
        assert (means == value).mean() == pytest.approx(share, abs=0.01)
    interval = statistics.bootstrap(runs, statistics.mean)
    assert interval == statistics.Interval(6.0, 0.0, 15.0, "runs and episodes")
    # Episodes pooled as if they were independent would claim more than two runs can say.
    pooled = statistics.bootstrap([np.concatenate(runs)], statistics.mean)
    alike = statistics.bootstrap([runs[0]] * 2, statistics.mean)
    assert pooled.over == "episodes"
    assert (alike.low, alike.high) == (0.0, 0.0)


def test_runs_may_have_different_numbers_of_episodes():
    runs = [np.array([2.0]), np.array([4.0, 4.0, 4.0])]
    counts = statistics._counts(np.random.default_rng(0), runs, 1000)
    assert {tuple(row) for row in np.stack([counts[:, 0], counts[:, 1:].sum(1)], 1).tolist()} == {
        (2, 0),
        (1, 3),
        (0, 6),
    }
    assert statistics.bootstrap(runs, statistics.mean).low == 2.0


@pytest.mark.parametrize("trim", [statistics.mean, iqm])
def test_counts_give_the_statistic_of_the_samples_they_count(trim):
    values = RNG.normal(size=7)
    counts = RNG.integers(0, 4, size=(50, 7)) + (np.arange(7) == 3)
    expected = [trim(np.repeat(values, row)) for row in counts]
    np.testing.assert_allclose(trim.of_counts(values, counts), expected)


def test_more_spread_between_runs_makes_the_interval_wider_than_pooling():
    runs = [RNG.normal(level, 1.0, size=100) for level in (0.0, 5.0, 10.0)]
    nested = statistics.bootstrap(runs, statistics.mean)
    pooled = statistics.bootstrap([np.concatenate(runs)], statistics.mean)
    assert nested.high - nested.low > 5 * (pooled.high - pooled.low)


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
        point = statistics.bootstrap(single(curves[:, t]), resamples=500, seed=2)
        assert (low[t], high[t]) == (point.low, point.high)


def test_one_sample_has_no_interval():
    interval = statistics.bootstrap([np.array([4.0])])
    assert (interval.estimate, interval.over) == (4.0, "")
    assert np.isnan([interval.low, interval.high]).all()
    assert np.isnan(statistics.bootstrap_band(np.ones((1, 3)))).all()
    assert np.isnan(statistics.ratio(single([4.0]), single([1.0, 2.0])).low)
    alone = statistics.probability_of_improvement([np.array([1.0])], [np.array([0.0])])
    assert alone.estimate == 1.0
    assert np.isnan(alone.low)


def test_a_comparison_says_no_more_than_its_weaker_side():
    one, three = [np.arange(1.0, 5.0)], [np.arange(1.0, 5.0)] * 3
    for compare in (statistics.ratio, statistics.probability_of_improvement):
        assert compare(three, three).over == "runs and episodes"
        assert compare(three, one).over == "episodes"
        assert compare(one, three).over == "episodes"


def test_probability_of_improvement_is_mann_whitney():
    x, y = RNG.integers(0, 6, size=14).astype(float), RNG.integers(0, 5, size=9).astype(float)
    u = float(scipy.stats.mannwhitneyu(x, y)[0])  # pyright: ignore
    expected = u / (len(x) * len(y))
    interval = statistics.probability_of_improvement([x], [y])
    assert interval.estimate == pytest.approx(expected)
    assert interval.low < expected < interval.high


def test_probability_of_improvement_counts_ties_half():
    same = [np.array([1.0, 1.0])]
    assert statistics.probability_of_improvement(same, same).estimate == 0.5


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
    interval = statistics.ratio(single([4.0, 6.0]), single([2.0, 2.0]))
    assert (interval.estimate, interval.low, interval.high) == (2.5, 2.0, 3.0)
    below = statistics.ratio(single([4.0, 6.0]), single([-1.0, -2.0]))
    assert np.isnan([below.estimate, below.low, below.high]).all()
    unsure = statistics.ratio(single([4.0, 6.0]), single([-1.0, 3.0]))
    assert unsure.estimate == 5.0
    assert np.isnan(unsure.low)


def test_bad_arguments_are_refused():
    samples = [np.arange(4.0)]
    with pytest.raises(ValueError, match=r"confidence is 95, expected a value in \(0, 1\)"):
        statistics.bootstrap(samples, confidence=95)
    with pytest.raises(ValueError, match="resamples is 0, expected >= 1"):
        statistics.bootstrap(samples, resamples=0)
    with pytest.raises(ValueError, match=r"runs of sizes \[4, 0\]"):
        statistics.bootstrap([*samples, np.array([])])
    with pytest.raises(ValueError, match="a sample is NaN"):
        statistics.bootstrap([np.array([1.0, np.nan])])
    with pytest.raises(ValueError, match=r"expected \[S >= 1, T\]"):
        statistics.bootstrap_band(np.arange(4.0))
