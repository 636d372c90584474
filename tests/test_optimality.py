"""Convergence of designs: the test of an optimum as read from a lens file."""

import pytest

from tasklens.show.optimality import optimum


@pytest.mark.parametrize("gain, reached", [(-0.5, True), (0.0219, True), (0.0221, False), (5.0, False)])
def test_an_optimum_is_reached_within_two_errors_and_what_is_negligible(gain, reached):
    """A standard error of 0.01: 0.022 is the largest gain of an optimum."""
    test = {"gain": gain, "error": 0.01, "step_um": 2.0, "along": "gradient", "images": 96}
    assert optimum({"local_optimum": test}).reached is reached


def test_a_lens_by_rays_alone_has_no_test():
    assert optimum({"figures": {}}) is None
