"""Convergence of designs: the test of an optimum as read from a lens file, and the optimality gap."""

import pandas
import pytest

from tasklens.report.optimality import gap, optimum


def test_a_gap_by_hand():
    """Four images: 0.1 above the better lens, with a paired deviation of 0.2 / sqrt(3), the error half of that."""
    losses = pandas.Series([1.0, 2.0, 3.0, 4.0])
    others = {"worse": losses + 1.0, "better": losses - pandas.Series([0.2, 0.0, 0.2, 0.0])}
    result = gap(losses, others)
    assert (result.nearest, result.difference) == ("better", pytest.approx(0.1, rel=1e-12))
    assert result.error == pytest.approx(0.1 / 3**0.5, rel=1e-12)


@pytest.mark.parametrize("gain, reached", [(-0.5, True), (0.0219, True), (0.0221, False), (5.0, False)])
def test_an_optimum_is_reached_within_two_errors_and_what_is_negligible(gain, reached):
    """A standard error of 0.01: 0.022 is the largest gain of an optimum."""
    test = {"gain": gain, "error": 0.01, "step_um": 2.0, "along": "gradient", "images": 96}
    assert optimum({"local_optimum": test}).reached is reached


def test_a_lens_by_rays_alone_has_no_test():
    assert optimum({"figures": {}}) is None
