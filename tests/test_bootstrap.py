"""Bootstrap intervals of cases with a known error: binomial counts, clustered captures, seeds."""

import math

import numpy
import pytest
import scipy.stats

from tasklens.show.bootstrap import CONFIDENCE, holm, p_value, resampled_means, resampled_over_seeds
from tasklens.show.bootstrap import interval as interval_of_means


def interval(values, seed=1, **options):
    """Interval of the mean of values (N, S) of N images and S seeds."""
    by_seed = resampled_means(values, 2 * seed, **options)
    return interval_of_means(resampled_over_seeds(by_seed, values.mean(0), 2 * seed + 1))


def test_holm_by_hand():
    """For p = 0.01, 0.04, 0.03, 0.005: 4 x 0.005, 3 x 0.01, 2 x 0.03, then 0.06 again, not 0.04: no decrease."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0] and holm([]) == []


@pytest.mark.parametrize("null", [0.0, -1.0, 2.5])
def test_a_p_value_agrees_with_the_interval_and_with_the_normal_distribution(null):
    """For 10 000 quantiles of a normal distribution with mean 1 and standard deviation 1."""
    means = 1 + scipy.stats.norm.ppf((numpy.arange(10_000) + 0.5) / 10_000)
    expected = 2 * scipy.stats.norm.sf(abs(1 - null))
    assert p_value(means, 1, null) == pytest.approx(expected, abs=3e-4)
    low, _ = interval_of_means(means)
    assert p_value(means, 1, low - 0.01) < 0.05 < p_value(means, 1, low + 0.01)
    assert p_value(means, 1, -99) == pytest.approx(2 / 10_001)


def test_a_p_value_of_five_seeds_is_that_of_students_test():
    """Without image noise, within a tenth: resampled deviations differ by 2 %, and small p, for Holm, by more."""
    for values in ([0.4, 0.7, 1.0, 1.3, 1.6], [3.0, 3.1, 2.9, 3.2, 3.3], [0.1, -0.2, 0.3, 0.2, 0.0]):
        means = resampled_over_seeds(numpy.tile(values, (10_000, 1)), numpy.array(values))
        expected = scipy.stats.ttest_1samp(values, 0).pvalue
        assert p_value(means, 5) == pytest.approx(expected, rel=0.1)
        low, _ = interval_of_means(means)
        assert p_value(means, 5, means.mean() - 1.02 * (means.mean() - low)) < 0.07


def test_means_of_draws_with_replacement():
    """Their mean is the mean of the values, their deviation is the standard error; columns share the draws."""
    values = numpy.random.default_rng(0).normal(size=(400, 1)) * [1, -2]
    means = resampled_means(values)
    assert means.shape == (10_000, 2)
    numpy.testing.assert_allclose(means[:, 1], -2 * means[:, 0], atol=1e-12)
    error = values[:, 0].std() / 20
    assert means[:, 0].mean() == pytest.approx(values[:, 0].mean(), abs=4 * error / 100)
    assert means[:, 0].std() == pytest.approx(error, rel=0.03)


def test_the_same_numbers_every_time():
    values = numpy.random.default_rng(0).random((50, 5))
    assert interval(values) == interval(values) != interval(values, seed=9)


def test_the_interval_of_one_seed_is_that_of_scipy():
    """Percentile method, paired means, against `scipy.stats.bootstrap` with 100 000 resamples.

    An end of the interval is the quantile q = 0.025 of R resampled means, nearly normal with deviation e. By chance it
    moves by e sqrt(q (1 - q) / R) / phi(z), with phi(z) = 0.0584: by 0.0267 e for our R of 10 000, by 0.0085 e for
    scipy's. Four deviations of the difference are 0.112 e.
    """
    generator = numpy.random.default_rng(0)
    recognised = generator.random((2, 300, 9)) < numpy.array([0.7, 0.65])[:, None, None]
    task, imaging = recognised.mean(-1) * generator.integers(0, 2, 300)  # skewed, and alike for both where it is zero
    oracle = scipy.stats.bootstrap(
        (task, imaging),
        lambda a, b, axis=-1: a.mean(axis) - b.mean(axis),
        paired=True,
        vectorized=True,
        n_resamples=100_000,
        batch=5_000,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=numpy.random.default_rng(100),
    )
    ends = interval((task - imaging)[:, None])
    error = oracle.standard_error
    assert error == pytest.approx((task - imaging).std() / math.sqrt(300), rel=0.02)
    assert ends == pytest.approx(tuple(oracle.confidence_interval), abs=0.112 * error)


@pytest.mark.parametrize(
    "seeds, spread, largest",  # with independent noise of images and seeds an interval may be too wide
    [(1, (0, 1, 0), 0.985), (5, (1, 0.1, 0.1), 0.985), (5, (0, 1, 0), 0.985), (5, (0.05, 0, 1), 0.995)],
)
def test_intervals_cover_the_truth_in_95_of_100_studies(seeds, spread, largest):
    """400 studies of 150 images determine a share of 0.95 to 0.011; as many p-values as intervals find nothing."""
    of_seeds, of_images, of_both = spread
    generator, covered, accepted = numpy.random.default_rng(2), 0, 0
    for k in range(400):
        values = of_seeds * generator.normal(size=(1, seeds)) + of_images * generator.normal(size=(150, 1))
        values = values + of_both * generator.normal(size=(150, seeds))
        by_seed = resampled_means(values, 2 * k, resamples=800)
        means = resampled_over_seeds(by_seed, values.mean(0), 2 * k + 1)
        low, high = interval_of_means(means)
        covered += low <= 0 <= high
        accepted += p_value(means, seeds) >= 0.05
    assert 0.915 <= covered / 400 <= largest
    assert accepted / 400 == pytest.approx(covered / 400, abs=0.01)
