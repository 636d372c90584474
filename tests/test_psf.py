"""PSFs from rays whose landing points are known."""

import pytest
import torch
from examples import difference, f64, landed

from tasklens.optics.psf import psf

PITCH, K = 2.0, 9  # [um], pixels
ORIGIN = f64([[0.0, 0.0]])


def cloud(count: int, seed: int, spread: float):
    """(1, 1, count) points, normally distributed with `spread` pixels."""
    generator = torch.Generator().manual_seed(seed)
    return spread * PITCH * 1e-3 * torch.randn(2, 1, 1, count, generator=generator, dtype=torch.float64)


def pixels():
    """Coordinates of the window's pixels [mm]."""
    return (torch.arange(K, dtype=torch.float64) - K // 2) * PITCH * 1e-3


def test_one_ray_is_shared_by_four_pixels():
    """At (1.25, -0.4) pixels: columns 1 and 2 get 3/4 and 1/4, rows -1 and 0 get 0.4 and 0.6."""
    grid = psf(landed([[[1.25 * PITCH * 1e-3]]], [[[-0.4 * PITCH * 1e-3]]]), ORIGIN, PITCH, K)[0, 0]
    expected = torch.zeros(K, K, dtype=torch.float64)
    centre = K // 2
    expected[centre - 1 : centre + 1, centre + 1 : centre + 3] = f64([[0.4], [0.6]]) * f64([[0.75, 0.25]])
    torch.testing.assert_close(grid, expected, rtol=0, atol=1e-14)


def test_energy_is_the_share_of_the_rays_inside():
    """Rays inside the window, lost rays and rays far beside it: sum(PSF) counts the first of all launched."""
    x, y = cloud(600, 0, 1.0).clamp(-3.9e-3 * PITCH, 3.9e-3 * PITCH)
    x[..., 200:300] += 1.0
    x[..., 300:350] = -1e30
    valid = torch.ones(1, 1, 600, dtype=torch.bool)
    valid[..., 350:450] = False
    assert float(psf(landed(x, y, valid), ORIGIN, PITCH, K).sum()) == pytest.approx(350 / 600, abs=1e-13)


def test_a_lost_ray_gives_nothing():
    x, y = cloud(10, 1, 1.0)
    assert float(psf(landed(x, y, torch.zeros(1, 1, 10, dtype=torch.bool)), ORIGIN, PITCH, K).abs().sum()) == 0


def test_centroid_of_the_psf_is_that_of_the_rays():
    """Bilinear sharing keeps the first moments, about any centre."""
    x, y = cloud(300, 2, 0.8)
    centre = f64([[0.3e-3, -0.7e-3]])
    grid = psf(landed(x, y), centre, PITCH, K)[0, 0]
    assert float(grid.sum()) == pytest.approx(1, abs=1e-13)
    assert float((grid * pixels()).sum()) == pytest.approx(float(x.mean() - centre[0, 0]), abs=1e-15)
    assert float((grid * pixels()[:, None]).sum()) == pytest.approx(float(y.mean() - centre[0, 1]), abs=1e-15)


def test_a_quarter_turn_of_the_rays_turns_the_psf():
    """(x, y) -> (-y, x) takes columns to rows: one clockwise turn with rows along y."""
    x, y = cloud(300, 3, 2.0)
    first, turned = (psf(landed(*points), ORIGIN, PITCH, K) for points in ((x, y), (-y, x)))
    torch.testing.assert_close(turned, torch.rot90(first, -1, (-2, -1)), rtol=0, atol=1e-15)


def test_fields_and_colours_do_not_mix():
    """Each field and wavelength has its own plane."""
    points = torch.randn(2, 3, 4, 50, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 2e-3
    centre = f64([[0, 0], [1e-3, 0], [0, -2e-3]])
    grid = psf(landed(*points), centre, PITCH, K)
    for f in range(3):
        for w in range(4):
            alone = psf(landed(*points[:, f : f + 1, w : w + 1]), centre[f : f + 1], PITCH, K)
            torch.testing.assert_close(grid[f, w], alone[0, 0], rtol=0, atol=1e-15)


def test_gradient_is_the_limit_of_differences():
    """The PSF is bilinear between pixel centres: its differences are exact while no ray crosses one."""
    points = cloud(40, 5, 2.5)
    weight = torch.randn(K, K, generator=torch.Generator().manual_seed(6), dtype=torch.float64)

    def value(points):
        return (psf(landed(*points), ORIGIN, PITCH, K) * weight).sum()

    leaf = points.clone().requires_grad_()
    gradient = torch.autograd.grad(value(leaf), leaf)[0]
    expected = difference(value, points, 1e-8)
    assert float(expected.abs().max()) > 0
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=1e-6 * float(expected.abs().max()))
