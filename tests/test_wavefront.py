"""The wavefront at the exit pupil: perfect and defocused lenses, third-order theory, lateral colour, lost rays."""

from dataclasses import replace

import pytest
import torch
from examples import WAVELENGTHS, difference, f64, hyperboloid, make_lens, random_lens

from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, trace_fields
from tasklens.optics.analysis.wavefront import wavefront
from tasklens.optics.analysis.zernike import rms_wavefront_error, zernike_coefficients
from tasklens.optics.lens import Lens
from tasklens.optics.view import View

REFERENCE = WAVELENGTHS[1]
PUPIL = sobol_disc(128, seed=0)


def view_at(fields, wavelengths=(REFERENCE,)) -> View:
    """Fields (x, y) as tangents, for a pinhole of 1 mm."""
    return View(f64(fields), 1.0, wavelengths, 9.0, 31)


def ellipsoid() -> Lens:
    """An ellipsoid, k = -1 / n^2, that images the axis perfectly inside its glass."""
    n = float(make_lens([0.0], [1.0], ("COC",)).refractive_indices((REFERENCE,))[1, 0])
    return make_lens([0.2], [5 * n / (n - 1)], ("COC",), conic=[-1 / n**2], semi_diameter=[3.0])


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
    wave = wavefront(lens, view_at([[0.0, 0.0]]), PUPIL)
    assert float(wave.opd.abs().max()) < 1e-9 and wave.centre.abs().max() < 1e-12
    assert float(wave.towards.norm(dim=-1).max()) > 0.2


def test_the_centre_of_the_sphere_is_a_tilt():
    """Spheres about the chief ray of the middle wavelength, not of each own wavelength: lateral colour, a plane in W.

    Moving the centre by D adds n' D . (chief ray - ray), direction cosines on the sphere, up to second order in D.
    """
    lens, view = stopped(random_lens(1), 0.2), view_at([[0.0, 0.0], [0.2, 0.1]], WAVELENGTHS)
    separate, common = wavefront(lens, view, PUPIL), wavefront(lens, view, PUPIL, chief_points(lens, view))
    assert common.centre.shape == separate.centre.shape == (2, 3, 2)
    torch.testing.assert_close(separate.opd[:, 1], common.opd[:, 1], rtol=0, atol=0, equal_nan=True)
    shift = common.centre - separate.centre
    assert 5e-3 < float(shift[1, 2].norm()) < 2e-2 and shift[0].abs().max() < 1e-15
    chief = wavefront(lens, view, 0 * PUPIL[:1]).towards
    turned = (shift[:, :, None] * (chief - separate.towards)).sum(-1) / (1e-3 * f64(WAVELENGTHS)[:, None])
    assert float(turned.nan_to_num().abs().max()) > 0.3
    torch.testing.assert_close(common.opd - separate.opd, turned, rtol=0, atol=5e-3, equal_nan=True)


def test_the_exit_pupil_is_the_image_of_the_stop():
    """A stop at d in front of a thin lens of focal length f: at -d f / (f - d) behind it, larger by f / (f - d)."""
    n = float(make_lens([0.0], [1.0], ("COC",)).refractive_indices((REFERENCE,))[1, 0])
    f, d, radius = 4.0, 1.5, 0.6
    media, semi = ("air", "COC", "air"), [radius, torch.inf, torch.inf]
    lens = make_lens([0.0, 1 / f / (n - 1), 0.0], [d, 0.0, 3.5], media, semi_diameter=semi)
    first_order = paraxial(lens, REFERENCE)
    assert float(first_order.exit_pupil_z) == pytest.approx(-d * f / (f - d), rel=1e-13)
    assert float(first_order.exit_pupil_radius) == pytest.approx(radius * f / (f - d), rel=1e-13)
    assert float(first_order.pupil_vergence) == pytest.approx(1 / (3.5 + d * f / (f - d)), rel=1e-13)
    behind = paraxial(replace(random_lens(1), stop=4, semi_diameter=f64([1.0] * 4 + [0.7])), REFERENCE)
    assert float(behind.exit_pupil_z) == 0.0 and float(behind.exit_pupil_radius) == pytest.approx(0.7, rel=1e-13)


def test_a_telecentric_lens_has_a_plane_reference():
    """The stop in the front focus: finite gradients, and paths between those of a pupil far in front and far behind."""
    n = float(make_lens([0.0], [1.0], ("COC",)).refractive_indices((REFERENCE,))[1, 0])
    semi, view = [0.5, torch.inf, torch.inf], view_at([[0.0, 0.1]])

    def lens(distance: torch.Tensor) -> Lens:
        base = make_lens([0.0, 1 / (4 * (n - 1)), 0.0], [0, 0, 4.0], ("air", "COC", "air"), semi_diameter=semi)
        return replace(base, thickness=torch.stack([distance, f64(0.0), f64(4.0)]))

    distance = f64(4.0).requires_grad_()
    wave = wavefront(lens(distance), view, PUPIL)
    assert abs(float(wave.curvature.detach())) < 1e-15
    assert torch.autograd.grad(wave.opd.square().sum(), distance)[0].isfinite()
    nearer, farther = (wavefront(lens(f64(4.0 + by)), view, PUPIL) for by in (-1e-5, 1e-5))
    assert float(nearer.curvature) > 0 > float(farther.curvature)
    torch.testing.assert_close(wave.opd.detach(), (nearer.opd + farther.opd) / 2, rtol=0, atol=1e-6)


def test_lost_rays_are_nan_and_those_of_a_lost_chief_ray_too():
    lens = make_lens([0.0, 0.3], [1.0, 5.0], ("air", "COC"), semi_diameter=[0.1, 0.5])
    view = view_at([[0.0, 0.0], [0.0, 0.45], [0.0, 0.52], [0.0, 1.0]], WAVELENGTHS)
    wave = wavefront(lens, view, PUPIL)
    valid = trace_fields(lens, view, PUPIL).valid
    assert valid[1].any() and valid[2].any() and not (valid[1].all() or valid[3].any())
    assert torch.equal(wave.opd[:2].isnan(), ~valid[:2]) and wave.opd[2:].isnan().all()
    assert torch.equal(wave.towards.isnan().any(-1), wave.opd.isnan())
    curvature = lens.curvature.clone().requires_grad_()
    opd = wavefront(replace(lens, curvature=curvature), view, PUPIL).opd
    gradient = torch.autograd.grad(rms_wavefront_error(opd, PUPIL)[:2].sum(), curvature)[0]
    assert gradient.isfinite().all() and gradient[1] != 0


def test_an_exit_pupil_on_the_image_has_no_wavefront():
    lens = make_lens([0.0], [0.0], ("air",), semi_diameter=[0.1])
    assert wavefront(lens, view_at([[0.0, 0.0], [0.1, 0.2]]), PUPIL).opd.isnan().all()


@pytest.mark.parametrize("name", ["curvature", "conic", "alpha", "thickness"])
def test_gradients_are_those_of_differences(name):
    """Gradients of coefficients and RMS at two fields and two colours, by every parameter of the lens."""
    lens = stopped(random_lens(1), 0.2, stop=2)
    view, pupil = view_at([[0.0, 0.05], [0.2, 0.1]], WAVELENGTHS[:2]), 0.8 * PUPIL

    def numbers(values: torch.Tensor) -> torch.Tensor:
        opd = wavefront(replace(lens, **{name: values}), view, pupil).opd
        return torch.cat([zernike_coefficients(opd, pupil, 8), rms_wavefront_error(opd, pupil)[..., None]], -1)

    values = getattr(lens, name).clone().requires_grad_()
    outputs = numbers(values).flatten()
    assert outputs.isfinite().all()
    gradient = torch.stack([torch.autograd.grad(v, values, retain_graph=True)[0] for v in outputs])
    expected = difference(lambda v: numbers(v).flatten(), values.detach(), 2e-5)
    torch.testing.assert_close(gradient, expected, rtol=1e-5, atol=1e-5)
