"""PSFs and spot figures from rays whose landing points are known."""

import math
from dataclasses import replace

import pytest
import torch
from examples import difference, f64, landed, random_lens

from tasklens.design.start import view
from tasklens.optics.analysis import (
    View,
    centroid,
    chief_points,
    clear_semi_diameters,
    encircled_energy_radius,
    evaluation_psf,
    figures,
    relative_illumination,
    rms_spot_radius,
    trace_fields,
)
from tasklens.optics.psf import psf
from tasklens.optics.pupil import rim, sobol_disc
from tasklens.optics.rays import Fate
from tasklens.settings import Spec

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


def test_spot_figures_of_a_ring():
    """n points on a circle: RMS and every encircled-energy radius are its radius, the centroid its centre."""
    angle = torch.arange(8, dtype=torch.float64) * math.pi / 4
    rays = landed((2 + 0.5 * torch.cos(angle))[None, None], (1 + 0.5 * torch.sin(angle))[None, None])
    middle = centroid(rays)
    torch.testing.assert_close(middle, f64([[2.0, 1.0]]), rtol=0, atol=1e-15)
    for radius in (rms_spot_radius(rays, middle), *(encircled_energy_radius(rays, middle, q) for q in (0.1, 0.5, 1))):
        assert float(radius) == pytest.approx(0.5, abs=1e-14)
    # About another point d away: RMS^2 = 0.5^2 + d^2
    assert float(rms_spot_radius(rays, f64([[2.0, 2.2]]))) == pytest.approx(math.hypot(0.5, 1.2), abs=1e-14)


def test_rms_is_a_root_of_a_mean_square_and_lost_rays_count_in_energy_only():
    """Rays at 1, 2 and 3 from the centre, a fourth lost: RMS sqrt(14 / 3), half of the launched light within 2."""
    rays = landed([[[1.0, -2.0, 3.0, 0.0]]], [[[0.0] * 4]], torch.tensor([[[True, True, True, False]]]))
    assert float(rms_spot_radius(rays, ORIGIN)) == pytest.approx(math.sqrt(14 / 3), rel=1e-15)
    assert float(encircled_energy_radius(rays, ORIGIN, 0.5)) == 2
    assert float(encircled_energy_radius(rays, ORIGIN, 0.75)) == 3
    assert math.isinf(float(encircled_energy_radius(rays, ORIGIN, 0.8)))


def test_a_field_without_rays_is_no_perfect_spot():
    rays = landed([[[0.0, 0.0]]], [[[0.0, 0.0]]], torch.zeros(1, 1, 2, dtype=torch.bool))
    assert math.isinf(float(rms_spot_radius(rays, centroid(rays))))


@pytest.fixture(scope="module")
def lens():
    """A short real lens with its stop in front, and a view of three of its fields."""
    looks = view(Spec(kernel=31))
    fields = looks.fields[[0, 4, 8]] * 0.5
    stopped = replace(random_lens(2), semi_diameter=f64([0.3, *[torch.inf] * 4]))
    return stopped, View(fields, looks.efl, looks.wavelengths, 9.0, 31)


def test_figures_agree_with_the_psf_and_the_rays(lens):
    """What a lens file reports follows from its rays: valid share, energy in the window, RMS, distortion, centre."""
    lens, looks = lens
    found = figures(lens, looks, 512)
    rays = trace_fields(lens, looks, sobol_disc(512, 0))
    grid = evaluation_psf(lens, looks, 512)
    # A ray within the outermost half pixel counts as inside, while the PSF shares it with the pixel beyond.
    assert (f64(found["energy_in_window"]) - grid.sum((-2, -1)).mean(1)).abs().max() < 0.02
    assert found["valid_fraction"] == [1.0] * 3
    torch.testing.assert_close(f64(found["rms_centroid_um"]), 1e3 * rms_spot_radius(rays, centroid(rays)))
    real = chief_points(lens, looks).norm(dim=-1)[1:] / looks.fields.norm(dim=-1)[1:] - 1
    torch.testing.assert_close(f64(found["distortion"][1:]), real)
    assert found["distortion"][0] == 0
    assert all(a <= b for a, b in zip(found["rms_centroid_um"], found["rms_chief_ray_um"], strict=True))
    assert all(a <= b for a, b in zip(found["radius_50_um"], found["radius_80_um"], strict=True))


def test_illumination_is_relative_to_the_axis_and_none_where_light_is_lost(lens):
    lens, looks = lens
    light = relative_illumination(lens, looks)
    assert float(light[0]) == pytest.approx(1, abs=1e-12)
    assert (light[1:] > 0).all()
    semi = lens.semi_diameter.clone()
    semi[-1] = clear_semi_diameters(lens, View(looks.fields[:1], looks.efl, looks.wavelengths, 9.0, 31))[-1] * 1.001
    clipped = relative_illumination(replace(lens, semi_diameter=semi), looks)
    assert float(clipped[0]) == pytest.approx(1, abs=1e-12)
    assert float(clipped[2]) == 0


def test_clear_semi_diameters_pass_all_light_and_not_more(lens):
    """A lens cut to them loses no ray of the rim; cut a little smaller at any surface it does."""
    lens, looks = lens
    used = clear_semi_diameters(lens, looks)
    assert trace_fields(replace(lens, semi_diameter=used), looks, rim(64)).valid.all()
    for i in range(1, len(used)):
        cut = used.clone()
        cut[i] *= 0.999
        rays = trace_fields(replace(lens, semi_diameter=cut), looks, rim(64))
        assert set(rays.lost_at[~rays.valid].tolist()) == {i}
        assert (rays.fate[~rays.valid] == Fate.OUTSIDE).all()
