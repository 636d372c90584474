"""Confidence intervals by resampling test images and seeds (Efron and Tibshirani 1993, chapters 6 and 13).

A row is one image, the mean over its captures at all fields; these are not independent and are not resampled.
"""

from collections.abc import Sequence

import numpy
from numpy import ndarray
from scipy.special import ndtri, stdtr, stdtrit

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
        indices = generator.integers(count, size=(rows, count)) + count * numpy.arange(rows)[:, None]
        counts = numpy.bincount(indices.ravel(), minlength=rows * count).reshape(rows, count)
        means.append(counts @ values / count)
    return numpy.concatenate(means)


def resampled_over_seeds(by_seed: ndarray, observed: ndarray, seed: int = 1) -> ndarray:
    """Compute resampled means (R,) over seeds from resampled values (R, S) and observed values (S,) of S seeds.

    With several seeds, the deviation from their mean of S of the S observed values (S,), sampled with replacement, is
    added to each mean. Since seeds are few, it is multiplied by sqrt(S / (S - 1)) t / z, with the quantiles t of
    Student's distribution for S - 1 degrees of freedom and z of the normal one: otherwise the coverage with five seeds
    is 86 %, not 95 %. Observed values also differ by the noise of their images. Noise that is independent between seeds
    is counted twice, so intervals may be too wide.
    """
    resamples, seeds = by_seed.shape
    means = by_seed.mean(1)
    if seeds > 1:
        quantile = (1 + CONFIDENCE) / 2
        stretch = numpy.sqrt(seeds / (seeds - 1)) * stdtrit(seeds - 1, quantile) / ndtri(quantile)
        indices = numpy.random.default_rng(seed).integers(seeds, size=(resamples, seeds))
        means = means + stretch * (observed[indices].mean(1) - observed.mean())
    return means


def interval(means: ndarray) -> tuple[float, float]:
    """Compute the percentile interval from resampled means (R,)."""
    low, high = numpy.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def p_value(means: ndarray, seeds: int, null: float = 0.0) -> float:
    """Compute the two-sided p-value of a mean of `null` from resampled means (R,) over `seeds` seeds.

    With one seed it is twice the fraction beyond `null`, at least 2 / (R + 1). With several seeds it is that of
    Student's distribution with their standard deviation: five seeds say little about the tails that Holm's correction
    needs.
    """
    if seeds > 1 and means.std() > 0:
        quantile = (1 + CONFIDENCE) / 2
        error = means.std() * ndtri(quantile) / stdtrit(seeds - 1, quantile)
        return float(2 * stdtr(seeds - 1, -abs(means.mean() - null) / error))
    beyond = min(int((means <= null).sum()), int((means >= null).sum()))
    return min(1.0, 2 * (beyond + 1) / (len(means) + 1))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values of a family of tests corrected by Holm's method (Scandinavian Journal of Statistics 6, 1979)."""
    order = sorted(range(len(p_values)), key=p_values.__getitem__)
    corrected, largest = [0.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        corrected[k] = largest
    return corrected
