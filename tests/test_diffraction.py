"""Point spread functions with diffraction: Airy's pattern, energy, the geometric limit, Optiland's Huygens PSF."""

import math
from dataclasses import replace

import numpy
import pytest
import torch
from examples import cooke_triplet, f64, hyperboloid
from reference_files import SHIPPED
from scipy.special import j0, j1

from tasklens.optics.analysis import diffraction
from tasklens.optics.analysis.diffraction import diffraction_psf, irradiance
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import gauss_quadrature, launch_fields
from tasklens.optics.analysis.spots import chief_points, evaluation_psf, trace_fields
from tasklens.optics.io import zemax
from tasklens.optics.lens import Lens
from tasklens.optics.tracing.trace import trace
from tasklens.optics.view import View

WAVELENGTH = 0.5893  # um, design wavelength of the hyperboloid


def perfect_lens() -> tuple[Lens, View, float]:
    """A lens without aberrations on the axis, its view, and wave number times numerical aperture [1/mm]."""
    lens, view = hyperboloid(f=10.0, radius=1.0), View(f64([[0.0, 0.0]]), 10.0, (WAVELENGTH,), 1.8, 31)
    sine = float(trace_fields(lens, view, f64([[0.0, 1.0]])).m.abs())
    assert sine == pytest.approx(0.1, rel=0.02)
    return lens, view, 2 * math.pi / (1e-3 * WAVELENGTH) * sine


def encircled_energy(v: float) -> float:
    """Rayleigh's fraction of energy within v = k sin(alpha) r."""
    return 1 - j0(v) ** 2 - j1(v) ** 2


def test_a_perfect_lens_has_the_pattern_of_airy():
    """Within 0.5 % of the peak out to the sixth dark ring; the energy within 20 um is Rayleigh's to 0.2 %."""
    lens, view, k = perfect_lens()
    x = torch.linspace(-0.02, 0.02, 201, dtype=torch.float64)
    pattern = irradiance(lens, view, 0, 0, x, x).numpy()
    radius = torch.hypot(x, x[:, None]).numpy()
    v = numpy.maximum(k * radius, 1e-9)
    airy = k**2 / (4 * math.pi) * (2 * j1(v) / v) ** 2
    assert numpy.abs(pattern - airy).max() < 5e-3 * airy.max()
    energy = pattern[radius <= 0.02].sum() * float(x[1] - x[0]) ** 2
    assert energy == pytest.approx(encircled_energy(0.02 * k), abs=2e-3)


def test_pixels_share_the_energy():
    """The energy of 31 pixels lies between Rayleigh's circles inside and around the window; the PSF is symmetric."""
    lens, view, k = perfect_lens()
    grid = diffraction_psf(lens, view, f64([[0.0, 0.0]]))[0, 0]
    half = 15.5e-3 * view.pixel_pitch_um
    assert encircled_energy(0.95 * half * k) < float(grid.sum()) < encircled_energy(1.05 * math.sqrt(2) * half * k)
    for other in (grid.flip(0), grid.flip(1), grid.T):
        torch.testing.assert_close(other, grid, rtol=0, atol=1e-6)
    shifted = diffraction_psf(lens, view, f64([[1e-3 * view.pixel_pitch_um, 0.0]]))[0, 0]
    torch.testing.assert_close(shifted[:, :-1], grid[:, 1:], rtol=0, atol=1e-5)


def test_short_wavelengths_give_the_spot():
    """Out of focus by 0.4 mm, 80 um wide: the difference from the spot falls as the root of the wavelength."""
    lens, view, _ = perfect_lens()
    blurred = replace(lens, thickness=lens.thickness + f64([0.0, 0.4]))

    def difference(wavelength: float) -> float:
        colour = replace(view, wavelengths_um=(wavelength,), kernel_size=61)
        # Refocus each wavelength, so that the defocus stays the same.
        focus = paraxial(blurred, wavelength).bfl - paraxial(blurred, WAVELENGTH).bfl
        moved = replace(blurred, thickness=blurred.thickness + torch.stack([0 * focus, focus]))
        pair = [evaluation_psf(moved, colour, 2**14, diffraction=with_waves)[0, 0] for with_waves in (False, True)]
        return float((pair[0] - pair[1]).abs().sum() / 2)

    long, short = difference(1.6), difference(0.4)
    assert short < 0.2 and 0.4 < short / long < 0.7


def test_lost_light_lacks_in_it_and_is_normalised():
    """An aperture of 0.8 of the radius behind the stop passes 64 % of the energy."""
    lens, view, _ = perfect_lens()
    stopped = replace(lens, semi_diameter=f64([float(lens.semi_diameter[0]), 0.8]))
    centre = chief_points(stopped, view)
    ratio = diffraction_psf(stopped, view, centre).sum() / diffraction_psf(lens, view, centre).sum()
    assert float(ratio) == pytest.approx(0.64, abs=0.02)
    assert 0.95 < float(evaluation_psf(stopped, view, 4096, diffraction=True).sum()) < 1


def test_a_ray_whose_neighbour_is_lost_has_no_wave(monkeypatch):
    """Its Jacobian would need the lost ray's direction; here neighbours are far, so that some are lost."""
    monkeypatch.setattr(diffraction, "_SHIFT", 2e-2)
    view = View(f64([[10.0, 10.0]]), 50.0, (0.5876,), 5.0, 31)
    clipped = cooke_triplet(semi_diameter=f64([6.5, *3 * [math.inf], 4.0, *4 * [math.inf]]))
    whole, remaining = (diffraction._waves(lens, view, 0, 0, 24).determinant for lens in (cooke_triplet(), clipped))
    assert len(remaining) < len(whole) and remaining.max() <= 1.01 * whole.max()


def test_a_field_without_light_is_dark():
    x = f64([9.9, 10.0, 10.1])
    dark = cooke_triplet(semi_diameter=f64([0.01, *3 * [math.inf], 4.0, *4 * [math.inf]]))
    assert not irradiance(dark, View(f64([[10.0, 10.0]]), 50.0, (0.5876,), 5.0, 31), 0, 0, x, x).any()


def huygens_fresnel(lens: Lens, view: View, x: torch.Tensor) -> torch.Tensor:
    """Irradiance [1/mm^2] at points (x, 0) by spherical waves from the last vertex plane, before any focus.

    U = (1 / lambda) sum_i sqrt(w_i dA_i) (d / r) exp(2 pi i (L_i + r) / lambda) / r, with the area dA_i of ray i in
    that plane, the distance r from its point there, and d from the plane.
    """
    wavelength, distance = 1e-3 * view.wavelengths_um[0], lens.thickness[-1]
    half, share = gauss_quadrature(200, 400)
    pupil, weight = torch.cat([half, half * f64([-1.0, 1.0])]), torch.cat([share, share]) / 2
    shift = 1e-6 * pupil.sign()
    points = torch.cat([pupil, *(pupil - shift * f64(axis) for axis in ([1.0, 0.0], [0.0, 1.0]))])
    at_vertex = replace(lens, thickness=lens.thickness * f64([1.0, 0.0]))
    start = launch_fields(lens, view, points)
    rays = trace(at_vertex, start, lens.refractive_indices(view.wavelengths_um))
    px, py, path = (v.reshape(3, -1) for v in (rays.x, rays.y, rays.path))
    (dx, ex), (dy, ey) = (((v[0] - v[1:]) / shift.T) for v in (px, py))
    amplitude = torch.sqrt(weight * math.pi * weight * (dx * ey - ex * dy).abs())
    values = []
    for position in x:
        r = torch.sqrt((px[0] - position) ** 2 + py[0] ** 2 + distance**2)
        wave = torch.polar(amplitude * distance / r**2, 2 * math.pi * (path[0] + r - distance) / wavelength)
        values.append((wave.sum() / wavelength).abs() ** 2)
    return torch.stack(values)


@pytest.mark.parametrize("alpha_10, moved_mm, share", [(0.0, 0.0, 1e-5), (0.02, 1.9, 0.04)])
def test_a_rim_that_is_given_up(monkeypatch, alpha_10, moved_mm, share):
    """In focus, and with an outer part of the pupil where the wavefront diverges, against spherical waves.

    Without the quarter wave the centre of the second has half the irradiance. Directions alone, without the position of
    the rim, leave a difference of 3 % there.
    """
    monkeypatch.setattr(diffraction, "_MARGIN", 32.0)  # the light of a symmetric lens meets on its axis
    lens, view, _ = perfect_lens()
    alpha = torch.zeros(2, 5, dtype=torch.float64)
    alpha[1, 4] = alpha_10
    lens = replace(lens, alpha=alpha, thickness=lens.thickness + f64([0.0, moved_mm]))
    x = torch.linspace(-0.03, 0.03, 41, dtype=torch.float64)
    profile, expected = irradiance(lens, view, 0, 0, x, f64([0.0, 0.0]))[0], huygens_fresnel(lens, view, x)
    assert float((profile - expected).abs().max() / expected.max()) < share


def test_against_huygens_in_optiland():
    """A phone lens off the axis: within 1 % of the peak. Optiland samples the pupil on a grid of 64 x 64 rays."""
    optiland = pytest.importorskip("optiland_lenses")
    from optiland.psf import HuygensPSF

    imported = zemax.read(
        SHIPPED / "lenses/cellphone/source/US-12032142-B2-e3.zmx", list((SHIPPED / "glass").glob("*.AGF"))
    )
    lens, channel = imported.lens, imported.primary
    is_stop = torch.arange(len(lens.semi_diameter)) == lens.stop
    lens = replace(lens, semi_diameter=torch.where(is_stop, lens.semi_diameter, torch.inf))
    efl = float(paraxial(lens, imported.wavelengths_um[channel]).efl)
    view = View(efl * f64([[0.15, 0.25]]), efl, imported.wavelengths_um, 1.8, 51)
    optic, (field,) = optiland.in_optiland(lens, view)
    psf = HuygensPSF(optic, tuple(field), view.wavelengths_um[channel], num_rays=64, image_size=12, pixel_pitch=1.6e-3)
    x = torch.linspace(-9.6e-3, 9.6e-3, 12, dtype=torch.float64)
    values = irradiance(lens, view, 0, channel, x + float(psf.cx), x + float(psf.cy)).flatten()
    reference = f64(numpy.asarray(psf.psf)).flatten()
    scale = (values @ reference) / (reference @ reference)  # unit of Optiland: 100 at the peak of a perfect lens
    assert float((values - scale * reference).abs().max() / values.max()) < 0.01
