"""PSFs from rays with known landing points, and from rays of a lens."""

from dataclasses import replace

import pytest
import torch
from examples import WAVELENGTHS, difference, f64, random_lens, rays_on_image

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, trace_fields, trace_with_chief
from tasklens.optics.psf import psf
from tasklens.optics.view import View

PITCH, K = 2.0, 9  # [um], pixels
ORIGIN = f64([[0.0, 0.0]])


def cloud(count: int, seed: int, spread: float):
    """(1, 1, count) points, normally distributed with `spread` pixels."""
    generator = torch.Generator().manual_seed(seed)
    return spread * PITCH * 1e-3 * torch.randn(2, 1, 1, count, generator=generator, dtype=torch.float64)


def pixels():
    """Coordinates of the window's pixels [mm]."""
    return (torch.arange(K, dtype=torch.float64) - K // 2) * PITCH * 1e-3


def psf_of_a_lens(fields, pupil, pitch: float, kernel: int):
    """PSFs of a lens with random aspheres behind a stop, centred on its chief rays."""
    lens = replace(random_lens(0), semi_diameter=f64([0.3, *[torch.inf] * 4]))
    view = View(f64(fields), 1.0, WAVELENGTHS, pitch, kernel)
    return psf(trace_fields(lens, view, pupil), chief_points(lens, view), pitch, kernel)


@pytest.mark.parametrize("stop, aperture", [(0, torch.inf), (2, torch.inf), (0, 0.5)])
def test_the_chief_ray_may_travel_with_the_others(stop, aperture):
    """Stop in front or inside, open or clear apertures: PSFs and gradients are those of a chief ray traced alone."""
    lens = random_lens(0)
    semi_diameter = torch.full_like(lens.semi_diameter, aperture)
    semi_diameter[stop] = 0.3
    lens = replace(lens, semi_diameter=semi_diameter, stop=stop)
    view, pupil = View(f64([[0.0, 0.0], [0.1, 0.3]]), 1.0, WAVELENGTHS, 20.0, 21), sobol_disc(64, seed=1)

    def result(alone: bool):
        curvature = lens.curvature.clone().requires_grad_()
        bent = replace(lens, curvature=curvature)
        rays, centre = trace_with_chief(bent, view, pupil)
        if alone:
            rays, centre = trace_fields(bent, view, pupil), chief_points(bent, view)
        grid = psf(rays, centre, 20.0, 21)
        return grid, *torch.autograd.grad(grid.square().sum(), curvature)

    for actual, expected in zip(result(alone=False), result(alone=True), strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-11, atol=1e-13)
    assert float(result(alone=False)[1].abs().max()) > 1e-3


def test_one_ray_is_shared_by_four_pixels():
    """At (1.25, -0.4) pixels: columns 1 and 2 get 3/4 and 1/4, rows -1 and 0 get 0.4 and 0.6."""
    grid = psf(rays_on_image([[[1.25 * PITCH * 1e-3]]], [[[-0.4 * PITCH * 1e-3]]]), ORIGIN, PITCH, K)[0, 0]
    expected = torch.zeros(K, K, dtype=torch.float64)
    centre = K // 2
    expected[centre - 1 : centre + 1, centre + 1 : centre + 3] = f64([[0.4], [0.6]]) * f64([[0.75, 0.25]])
    torch.testing.assert_close(grid, expected, rtol=0, atol=1e-14)


def test_energy_is_the_share_of_the_rays_inside():
    """Rays inside the window, lost rays and rays far outside: sum(PSF) is the share inside of all launched rays."""
    x, y = cloud(600, 0, 1.0).clamp(-3.9e-3 * PITCH, 3.9e-3 * PITCH)
    x[..., 200:300] += 1.0
    x[..., 300:350] = -1e30
    valid = torch.ones(1, 1, 600, dtype=torch.bool)
    valid[..., 350:450] = False
    assert float(psf(rays_on_image(x, y, valid), ORIGIN, PITCH, K).sum()) == pytest.approx(350 / 600, abs=1e-13)


def test_centroid_of_the_psf_is_that_of_the_rays():
    """Bilinear sharing keeps the first moments, about any centre."""
    x, y = cloud(300, 2, 0.8)
    centre = f64([[0.3e-3, -0.7e-3]])
    grid = psf(rays_on_image(x, y), centre, PITCH, K)[0, 0]
    assert float(grid.sum()) == pytest.approx(1, abs=1e-13)
    assert float((grid * pixels()).sum()) == pytest.approx(float(x.mean() - centre[0, 0]), abs=1e-15)
    assert float((grid * pixels()[:, None]).sum()) == pytest.approx(float(y.mean() - centre[0, 1]), abs=1e-15)


def test_a_quarter_turn_of_field_and_pupil_turns_the_psf():
    """A rotationally symmetric lens has no preferred direction: (x, y) -> (-y, x) in field and pupil."""
    fields, pupil = f64([[0.1, 0.05], [-0.02, 0.15]]), sobol_disc(256, seed=0)
    turn = f64([[0, 1], [-1, 0]])
    first, turned = (psf_of_a_lens(fields @ t, pupil @ t, 20.0, 21) for t in (torch.eye(2, dtype=torch.float64), turn))
    assert float(first.sum((-2, -1)).min()) > 0.5 and float(first.max()) < 0.2
    torch.testing.assert_close(turned, torch.rot90(first, -1, (-2, -1)), rtol=0, atol=1e-13)


def test_fields_and_colours_do_not_mix():
    """Each field and wavelength has its own plane."""
    points = torch.randn(2, 3, 4, 50, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 2e-3
    centre = f64([[0, 0], [1e-3, 0], [0, -2e-3]])
    grid = psf(rays_on_image(*points), centre, PITCH, K)
    for f in range(3):
        for w in range(4):
            alone = psf(rays_on_image(*points[:, f : f + 1, w : w + 1]), centre[f : f + 1], PITCH, K)
            torch.testing.assert_close(grid[f, w], alone[0, 0], rtol=0, atol=1e-15)


def test_gradient_is_the_limit_of_differences():
    """The PSF is bilinear between pixel centres: its differences are exact while no ray crosses one."""
    points = cloud(40, 5, 2.5)
    weight = torch.randn(K, K, generator=torch.Generator().manual_seed(6), dtype=torch.float64)

    def value(points):
        return (psf(rays_on_image(*points), ORIGIN, PITCH, K) * weight).sum()

    leaf = points.clone().requires_grad_()
    gradient = torch.autograd.grad(value(leaf), leaf)[0]
    expected = difference(value, points, 1e-8)
    assert float(expected.abs().max()) > 0
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=1e-6 * float(expected.abs().max()))
