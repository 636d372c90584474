"""The optimality gap: how far the loss of a lens is from the least of the others."""

import pandas
import pytest

from tasklens.report.optimality import gap


def test_a_gap_by_hand():
    """Four images: 0.1 above the better lens, with a paired deviation of 0.2 / sqrt(3), the error half of that."""
    own = pandas.Series([1.0, 2.0, 3.0, 4.0])
    others = {"worse": own + 1.0, "better": own - pandas.Series([0.2, 0.0, 0.2, 0.0])}
    found = gap(own, others)
    assert (found.nearest, found.difference) == ("better", pytest.approx(0.1, rel=1e-12))
    assert found.error == pytest.approx(0.1 / 3**0.5, rel=1e-12)
    assert found.converged  # 0.1 is less than twice 0.058


@pytest.mark.parametrize("difference, converged", [(-0.5, True), (0.019, True), (0.021, False), (5.0, False)])
def test_converged_is_below_the_least_or_within_two_errors(difference, converged):
    """Differences of mean `difference` and standard error 0.01."""
    noise = pandas.Series([0.01, -0.01] * 50) * (99 / 100) ** 0.5 * 10
    own = pandas.Series(range(100), dtype=float)
    found = gap(own + difference + noise, {"other": own, "far": own + 9})
    assert found.error == pytest.approx(0.01, rel=1e-9)
    assert found.converged is converged


@pytest.mark.parametrize("more, converged", [(9e-5, True), (2e-4, False)])
def test_a_lens_that_a_design_returned_unchanged_is_no_better_than_itself(more, converged):
    """Losses that differ by rounding, alike for all images."""
    own = pandas.Series([1.0, 2.0, 3.0])
    assert gap(own + more, {"candidate": own}).converged is converged
