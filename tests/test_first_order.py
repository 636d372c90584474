"""Paraxial data and pupils, compared with textbook formulas and real rays close to the axis."""

import math
from dataclasses import replace

import pytest
import torch
from examples import f64, make_lens

from tasklens.materials.catalogues import builtin
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import gauss_quadrature, sobol_disc

N = builtin("COC").refractive_index(0.5893)


def test_afocal_lens_has_no_power_but_a_gradient():
    lens = make_lens([0.0, 0.0], [1.0, 1.0], ("COC", "air"))
    curvature = lens.curvature.clone().requires_grad_()
    first_order = paraxial(replace(lens, curvature=curvature), 0.5893)
    assert float(first_order.power.detach()) == 0 and math.isinf(float(first_order.efl.detach()))
    gradient = torch.autograd.grad(first_order.power, curvature)[0]
    torch.testing.assert_close(gradient, f64([N - 1, 1 - N]), rtol=1e-14, atol=0)


def test_sobol_points_are_uniform_over_the_disc():
    """Moments of the unit disc: <x> = <y> = <xy> = 0, <r^2> = 1 / 2, <r^4> = 1 / 3; one set per seed."""
    x, y = sobol_disc(4096, seed=3).unbind(-1)
    square = x**2 + y**2
    assert square.max() <= 1
    moments = torch.stack([v.mean() for v in (x, y, x * y, x**2 - y**2, square, square**2)])
    torch.testing.assert_close(moments, f64([0, 0, 0, 0, 1 / 2, 1 / 3]), rtol=0, atol=1e-3)
    assert torch.equal(sobol_disc(64, seed=3), sobol_disc(64, seed=3))
    assert not torch.equal(sobol_disc(64, seed=3), sobol_disc(64, seed=4))


@pytest.mark.parametrize("rings", [1, 2, 4, 6])
def test_gauss_quadrature_is_exact_on_polynomials(rings):
    """Over the disc <x^2a y^2b> = (2a)! (2b)! / (4^(a+b) a! b! (a+b+1)!), odd powers of y vanish."""
    degree = 4 * rings - 2
    points, weights = gauss_quadrature(rings, degree)
    assert float(weights.sum()) == pytest.approx(1, abs=1e-14)
    x, y = points.unbind(-1)
    for a in range(degree // 2 + 1):
        for p in range(degree - 2 * a + 1):
            mean, b = float((weights * x ** (2 * a) * y**p).sum()), p // 2
            f = math.factorial
            exact = f(2 * a) * f(2 * b) / (4 ** (a + b) * f(a) * f(b) * f(a + b + 1)) if p % 2 == 0 else 0
            assert mean == pytest.approx(exact, abs=1e-14), (a, p)
