"""Zernike polynomials against Noll's table, coefficients and RMS of known wavefronts, Strehl against diffraction."""

import math

import pytest
import torch
from examples import f64

from tasklens.optics.analysis.pupil import gauss_quadrature, sobol_disc
from tasklens.optics.analysis.zernike import (
    noll_orders,
    rms_wavefront_error,
    zernike,
    zernike_coefficients,
)

PUPIL = sobol_disc(256, seed=0)


def disc(rings: int, arms: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Points and weights of a quadrature over the whole disc."""
    points, weights = gauss_quadrature(rings, arms)
    return torch.cat([points, points * f64([-1.0, 1.0])]), torch.cat([weights, weights]) / 2


def test_order_of_the_terms():
    """Every (n, m) once, by rising n and then |m|; cosines are even, sines odd."""
    orders = [noll_orders(j) for j in range(1, 67)]
    assert sorted(orders) == sorted((n, m) for n in range(11) for m in range(-n, n + 1, 2))
    assert [(n, abs(m)) for n, m in orders] == sorted((n, abs(m)) for n, m in orders)
    assert all(m == 0 or (m > 0) == (j % 2 == 0) for j, (_, m) in enumerate(orders, 1))
    with pytest.raises(ValueError, match="starts at 1"):
        noll_orders(0)


def test_terms_are_orthonormal_over_the_disc():
    points, weights = disc(12, 24)
    terms = zernike(points, 66)
    gram = (terms * weights[:, None]).mT @ terms
    torch.testing.assert_close(gram, torch.eye(66, dtype=torch.float64), rtol=0, atol=1e-12)


def test_a_known_sum_is_found_where_rays_are_lost():
    """Several wavefronts at once, each with its own lost rays; the coefficients agree to rounding."""
    generator = torch.Generator().manual_seed(0)
    coefficients = torch.randn(2, 3, 21, generator=generator, dtype=torch.float64)
    opd = coefficients @ zernike(PUPIL, 21).mT
    opd[torch.rand(opd.shape, generator=generator) < 0.3] = torch.nan
    torch.testing.assert_close(zernike_coefficients(opd, PUPIL, 21), coefficients, rtol=0, atol=1e-11)


def test_too_few_points_determine_nothing():
    """Three points do not fix four terms, points on a line not three, and no point fixes none."""
    opd = torch.full((3, 256), torch.nan, dtype=torch.float64)
    opd[0, :3] = 1.0
    assert not zernike_coefficients(opd[0], PUPIL, 3).isnan().any()
    assert zernike_coefficients(opd, PUPIL, 4).isnan().all()
    line = torch.stack([PUPIL[:, 0], 0 * PUPIL[:, 0]], -1)
    assert zernike_coefficients(torch.ones(256, dtype=torch.float64), line, 3).isnan().all()
    assert rms_wavefront_error(opd, PUPIL, removed=4).isnan().all()
    assert rms_wavefront_error(opd, PUPIL, removed=0).isnan().tolist() == [False, True, True]


def test_rms_without_the_first_terms():
    """Points of a quadrature of equal weights: the coefficients of an orthonormal sum, as squares."""
    angle = torch.arange(16, dtype=torch.float64) * math.pi / 8
    square = (f64([1.0, 3, 5, 7, 9, 11, 13, 15]) / 16).sqrt()[:, None]
    points = torch.stack([square * torch.cos(angle), square * torch.sin(angle)], -1).reshape(-1, 2)
    coefficients = f64([3.0, 2.0, -1.0, 0.5])
    opd = coefficients @ zernike(points, 4).mT
    for removed, expected in ((1, math.hypot(2, 1, 0.5)), (3, 0.5), (4, 0.0)):
        assert float(rms_wavefront_error(opd, points, removed)) == pytest.approx(expected, rel=0.02, abs=1e-14)
    assert float(rms_wavefront_error(opd, points, 0)) == pytest.approx(float(opd.square().mean().sqrt()), rel=1e-14)
