"""The wavefront at the exit pupil: perfect and defocused lenses, third-order theory, lateral colour, lost rays."""

import math
from dataclasses import replace

import pytest
import torch
from examples import WAVELENGTHS, assert_derivative, f64, hyperboloid, make_lens, random_lens, view_at

from tasklens.materials.catalogues import builtin
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, trace_fields
from tasklens.optics.analysis.wavefront import path_differences, rms_wavefront_error
from tasklens.optics.lens import Lens

REFERENCE = WAVELENGTHS[1]
PUPIL = sobol_disc(128, seed=0)
N = builtin("COC").refractive_index(REFERENCE)


def ellipsoid() -> Lens:
    """An ellipsoid, k = -1 / n^2, that images the axis perfectly inside its glass."""
    return make_lens([0.2], [5 * N / (N - 1)], ("COC",), conic=[-1 / N**2], semi_diameter=[3.0])


def stopped(lens: Lens, radius: float, stop: int = 0) -> Lens:
    """The lens in focus, with an entrance pupil of this radius and without other apertures."""
    lens = replace(lens, stop=stop, semi_diameter=torch.ones_like(lens.semi_diameter))
    first_order = paraxial(lens, REFERENCE)
    semi = torch.full_like(lens.semi_diameter, torch.inf)
    semi[stop] = radius / first_order.entrance_pupil_radius
    return replace(lens, thickness=torch.cat([lens.thickness[:-1], first_order.bfl[None]]), semi_diameter=semi)


@pytest.mark.parametrize("lens", [hyperboloid(radius=20.0), ellipsoid()], ids=["hyperboloid", "ellipsoid"])
def test_a_perfect_lens_has_no_path_difference(lens):
    """F/1.5 in air, and an image in glass of half angle 13 degrees: less than a billionth of a wave."""
    assert float(path_differences(lens, view_at([[0.0, 0.0]]), PUPIL).abs().max()) < 1e-9


def test_defocus_without_piston():
    """W = d NA^2 p^2 / 2 for an image at d in front of the plane: an RMS of d NA^2 / (4 sqrt(3)) about its mean."""
    shift, aperture = 0.4, 0.5 / 50
    opd = path_differences(hyperboloid(shift), view_at([[0.0, 0.0]]), sobol_disc(1024, 0))[0, 0]
    expected = shift * aperture**2 / (1e-3 * REFERENCE) / 4 / math.sqrt(3)
    assert float(rms_wavefront_error(opd, sobol_disc(1024, 0))) == pytest.approx(expected, rel=1e-2)


def test_rms_without_piston_and_tilt_where_rays_are_lost():
    """Several wavefronts at once; too few points, or points on a line, determine nothing."""
    x, y = PUPIL.unbind(-1)
    opd = torch.stack([3 + 2 * x - y, 3 + 2 * x - y + 0.5 * (x * x - y * y), x, x])
    opd[:2, ::3], opd[2, 2:], opd[3] = torch.nan, torch.nan, torch.nan
    plane, bent, *few = rms_wavefront_error(opd, PUPIL).tolist()
    assert plane < 1e-14 and bent == pytest.approx(0.5 / math.sqrt(6), rel=0.1) and all(map(math.isnan, few))
    line = torch.stack([x, 0 * x], -1)
    assert math.isnan(float(rms_wavefront_error(x, line)))


def test_the_centre_of_the_sphere_is_a_tilt():
    """Spheres about the chief ray of the middle wavelength, not of each wavelength: lateral colour, a plane in W."""
    lens, view = stopped(random_lens(1), 0.2), view_at([[0.0, 0.0], [0.2, 0.1]], wavelengths=WAVELENGTHS)
    separate = path_differences(lens, view, PUPIL)
    common = path_differences(lens, view, PUPIL, chief_points(lens, view))
    torch.testing.assert_close(separate[:, 1], common[:, 1], rtol=0, atol=0, equal_nan=True)
    assert float((common - separate).nan_to_num().abs().max()) > 0.3
    assert float(rms_wavefront_error(common - separate, PUPIL).max()) < 0.01


def test_the_exit_pupil_is_the_image_of_the_stop():
    """A stop at d in front of a thin lens of focal length f: at -d f / (f - d) behind it, larger by f / (f - d)."""
    f, d, radius = 4.0, 1.5, 0.6
    media, semi = ("air", "COC", "air"), [radius, torch.inf, torch.inf]
    lens = make_lens([0.0, 1 / f / (N - 1), 0.0], [d, 0.0, 3.5], media, semi_diameter=semi)
    first_order = paraxial(lens, REFERENCE)
    assert float(first_order.exit_pupil_z) == pytest.approx(-d * f / (f - d), rel=1e-13)
    assert float(first_order.exit_pupil_radius) == pytest.approx(radius * f / (f - d), rel=1e-13)
    assert float(first_order.pupil_vergence) == pytest.approx(1 / (3.5 + d * f / (f - d)), rel=1e-13)
    behind = paraxial(replace(random_lens(1), stop=4, semi_diameter=f64([1.0] * 4 + [0.7])), REFERENCE)
    assert float(behind.exit_pupil_z) == 0.0 and float(behind.exit_pupil_radius) == pytest.approx(0.7, rel=1e-13)


def test_a_telecentric_lens_has_a_plane_reference():
    """The stop in the front focus: finite gradients, and paths between those of a pupil far in front and far behind."""
    semi, view = [0.5, torch.inf, torch.inf], view_at([[0.0, 0.1]])

    def lens(distance: torch.Tensor) -> Lens:
        base = make_lens([0.0, 1 / (4 * (N - 1)), 0.0], [0, 0, 4.0], ("air", "COC", "air"), semi_diameter=semi)
        return replace(base, thickness=torch.stack([distance, f64(0.0), f64(4.0)]))

    distance = f64(4.0).requires_grad_()
    opd = path_differences(lens(distance), view, PUPIL)
    assert abs(float(paraxial(lens(distance.detach()), REFERENCE).pupil_vergence)) < 1e-15
    assert torch.autograd.grad(opd.square().sum(), distance)[0].isfinite()
    nearer, farther = (path_differences(lens(f64(4.0 + by)), view, PUPIL) for by in (-1e-5, 1e-5))
    vergences = [float(paraxial(lens(f64(4.0 + by)), REFERENCE).pupil_vergence) for by in (-1e-5, 1e-5)]
    assert vergences[0] > 0 > vergences[1]
    torch.testing.assert_close(opd.detach(), (nearer + farther) / 2, rtol=0, atol=1e-6)


def test_lost_rays_are_nan_and_those_of_a_lost_chief_ray_too():
    lens = make_lens([0.0, 0.3], [1.0, 5.0], ("air", "COC"), semi_diameter=[0.1, 0.5])
    view = view_at([[0.0, 0.0], [0.0, 0.45], [0.0, 0.52], [0.0, 1.0]], wavelengths=WAVELENGTHS)
    opd = path_differences(lens, view, PUPIL)
    valid = trace_fields(lens, view, PUPIL).valid
    assert valid[1].any() and valid[2].any() and not (valid[1].all() or valid[3].any())
    assert torch.equal(opd[:2].isnan(), ~valid[:2]) and opd[2:].isnan().all()
    curvature = lens.curvature.clone().requires_grad_()
    opd = path_differences(replace(lens, curvature=curvature), view, PUPIL)
    gradient = torch.autograd.grad(rms_wavefront_error(opd, PUPIL)[:2].sum(), curvature)[0]
    assert gradient.isfinite().all() and gradient[1] != 0


def test_an_exit_pupil_on_the_image_has_no_wavefront():
    lens = make_lens([0.0], [0.0], ("air",), semi_diameter=[0.1])
    assert path_differences(lens, view_at([[0.0, 0.0], [0.1, 0.2]]), PUPIL).isnan().all()


@pytest.mark.parametrize("name", ["curvature", "conic", "alpha", "thickness"])
def test_gradients_are_those_of_differences(name):
    """Of the RMS at two fields and two colours, by each parameter of the lens."""
    lens = stopped(random_lens(1), 0.2, stop=2)
    view, pupil = view_at([[0.0, 0.05], [0.2, 0.1]], wavelengths=WAVELENGTHS[:2]), 0.8 * PUPIL

    def numbers(values: torch.Tensor) -> torch.Tensor:
        opd = path_differences(replace(lens, **{name: values}), view, pupil)
        return rms_wavefront_error(opd, pupil).flatten()

    step = {"conic": 1e-2, "alpha": 5e-6, "thickness": 1e-4}.get(name, 2e-5)
    assert_derivative(numbers, getattr(lens, name), step, seed=3, rtol=1e-6)
