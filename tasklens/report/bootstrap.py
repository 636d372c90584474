"""Confidence intervals by resampling test images and seeds (Efron and Tibshirani 1993, chapters 6 and 13).

A row is one image, the mean over its nine captures: these are not independent, and not resampled.
"""

import numpy
from numpy import ndarray
from scipy.special import ndtri, stdtrit

RESAMPLES = 10_000
CONFIDENCE = 0.95
_BLOCK = 2_000_000  # image counts in memory at once


def resampled_means(values: ndarray, seed: int = 0, resamples: int = RESAMPLES) -> ndarray:
    """Compute the means (R, C) of the columns of `values` (N, C) over R samples of N rows with replacement.

    All columns have the same samples, so that measurements on the same images stay paired.
    """
    count = len(values)
    generator = numpy.random.default_rng(seed)
    block = max(1, _BLOCK // count)
    means = []
    for start in range(0, resamples, block):
        rows = min(block, resamples - start)
        drawn = generator.integers(count, size=(rows, count)) + count * numpy.arange(rows)[:, None]
        times = numpy.bincount(drawn.ravel(), minlength=rows * count).reshape(rows, count)
        means.append(times @ values / count)
    return numpy.concatenate(means)


def interval(by_seed: ndarray, seed: int = 1) -> tuple[float, float]:
    """Compute the percentile interval of the mean over seeds, from resampled values (R, S) of S seeds.

    With several seeds, S of the S values of each row are sampled with replacement. Since seeds are few, the deviation
    caused by this is multiplied by sqrt(S / (S - 1)) t / z, with the quantiles t of Student's distribution for S - 1
    degrees of freedom and z of the normal one: otherwise the coverage with five seeds is 86 %, not 95 %.
    """
    resamples, seeds = by_seed.shape
    means = by_seed.mean(1)
    if seeds > 1:
        quantile = (1 + CONFIDENCE) / 2
        stretch = numpy.sqrt(seeds / (seeds - 1)) * stdtrit(seeds - 1, quantile) / ndtri(quantile)
        drawn = numpy.random.default_rng(seed).integers(seeds, size=(resamples, seeds))
        means = means + stretch * (numpy.take_along_axis(by_seed, drawn, 1).mean(1) - means)
    low, high = numpy.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)
