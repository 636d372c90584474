"""Bootstrap intervals of cases with a known error: binomial counts, clustered captures, seeds."""

import math

import numpy
import pytest
import scipy.stats

from tasklens.show.bootstrap import CONFIDENCE, holm, p_value, resampled_means, resampled_over_seeds
from tasklens.show.bootstrap import interval as interval_of_means

Z = 1.96


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


def test_identical_lenses_differ_by_nothing():
    assert interval(numpy.zeros((100, 5))) == (0, 0)


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


@pytest.mark.parametrize("same, captures", [(True, 1), (False, 9)])
def test_width_is_that_of_a_binomial_count_of_images(same, captures):
    """Two lenses recognise with p = 0.7 and 0.6. Nine captures that always agree are worth one, independent ones nine.

    Width 2 z sqrt((p (1 - p) + q (1 - q)) / (N k)) for k captures worth of each of N images; chance moves it by 3 %.
    """
    images, generator = 2000, numpy.random.default_rng(1)
    shape = (2, images, 1 if same else 9)
    recognised = generator.random(shape) < numpy.array([0.7, 0.6])[:, None, None]
    accuracy = recognised.mean(-1)
    low, high = interval((accuracy[0] - accuracy[1])[:, None])
    width = 2 * Z * math.sqrt((0.7 * 0.3 + 0.6 * 0.4) / (images * captures))
    assert high - low == pytest.approx(width, rel=0.06)
    assert low < 0.1 < high


@pytest.mark.parametrize("seed", range(3))
def test_the_interval_of_one_seed_is_that_of_scipy(seed):
    """Percentile method, paired means, against `scipy.stats.bootstrap` with 100 000 resamples.

    An end of the interval is the quantile q = 0.025 of R resampled means, nearly normal with deviation e. By chance it
    moves by e sqrt(q (1 - q) / R) / phi(z), with phi(z) = 0.0584: by 0.0267 e for our R of 10 000, by 0.0085 e for
    scipy's. Four deviations of the difference are 0.112 e.
    """
    generator = numpy.random.default_rng(seed)
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
        rng=numpy.random.default_rng(100 + seed),
    )
    ends = interval((task - imaging)[:, None])
    error = oracle.standard_error
    assert error == pytest.approx((task - imaging).std() / math.sqrt(300), rel=0.02)
    assert ends == pytest.approx(tuple(oracle.confidence_interval), abs=0.112 * error)


def covered(seeds: int, of_seeds: float, of_images: float, of_both: float) -> float:
    """Share of 400 synthetic studies of 150 images whose interval holds the true mean, zero."""
    generator, hits = numpy.random.default_rng(2), 0
    for k in range(400):
        values = of_seeds * generator.normal(size=(1, seeds)) + of_images * generator.normal(size=(150, 1))
        values = values + of_both * generator.normal(size=(150, seeds))
        low, high = interval(values, k, resamples=800)
        hits += low <= 0 <= high
    return hits / 400


@pytest.mark.parametrize("seeds, spread", [(1, (0, 1, 0)), (5, (1, 0.1, 0.1)), (5, (0, 1, 0))])
def test_intervals_cover_the_truth_in_95_of_100_studies(seeds, spread):
    """400 draws determine a share of 0.95 to 0.011; with five seeds the interval may be too wide."""
    assert 0.915 <= covered(seeds, *spread) <= 0.985


def test_intervals_of_seeds_and_images_together_are_not_too_short():
    assert covered(5, 0.1, 1, 1) >= 0.93


@pytest.mark.parametrize("of_seeds, of_images, of_both", [(0.05, 0, 1), (0.1, 0.5, 1), (1, 0.1, 0)])
def test_a_difference_of_nothing_is_seldom_found(of_seeds, of_images, of_both):
    """At 5 %: in at most 7 of 100 synthetic studies of five seeds, even if the seeds have independent image noise."""
    generator, count = numpy.random.default_rng(3), 0
    for k in range(400):
        values = of_seeds * generator.normal(size=(1, 5)) + of_images * generator.normal(size=(150, 1))
        values = values + of_both * generator.normal(size=(150, 5))
        means = resampled_over_seeds(resampled_means(values, k, resamples=800), values.mean(0), k + 1)
        count += p_value(means, 5) < 0.05
    assert 1 <= count <= 28
