"""Seidel sums against real rays and textbook thin lenses; field curvature against rays next to the chief ray."""

import math
from dataclasses import replace

import pytest
import torch
from examples import WAVELENGTHS, difference, f64, make_lens, random_lens

from tasklens.optics.analysis.aberrations import SeidelSums, field_curvature, seidel_sums
from tasklens.optics.analysis.paraxial import paraxial, paraxial_ray, powers_and_thicknesses
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_rays, spot_diagram, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.view import View

REFERENCE = WAVELENGTHS[1]


def view_at(tangents, wavelengths=(REFERENCE,)) -> View:
    """Fields on +y with these tangents, for a pinhole of 1 mm."""
    tangents = f64(tangents)
    return View(torch.stack([torch.zeros_like(tangents), tangents], -1), 1.0, wavelengths, 9.0, 31)


def focused(lens: Lens, pupil_radius: float) -> Lens:
    """The lens with its paraxial focus on the image plane and an entrance pupil of this radius."""
    first_order = paraxial(replace(lens, semi_diameter=torch.ones_like(lens.semi_diameter)), REFERENCE)
    semi = torch.full_like(lens.semi_diameter, torch.inf)
    semi[lens.stop] = pupil_radius / first_order.entrance_pupil_radius
    return replace(lens, thickness=torch.cat([lens.thickness[:-1], first_order.bfl[None]]), semi_diameter=semi)


def last_angle(lens: Lens) -> torch.Tensor:
    """n' u' of the marginal ray behind the lens."""
    first_order = paraxial(lens, REFERENCE)
    return -first_order.entrance_pupil_radius * first_order.power


def totals(sums: SeidelSums) -> tuple[torch.Tensor, ...]:
    return tuple(values.sum() for values in vars(sums).values())


def without_aspheres(lens: Lens) -> Lens:
    return replace(lens, conic=0 * lens.conic, alpha=0 * lens.alpha)


@pytest.mark.parametrize("stop", [0, 2, 4])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shape", [without_aspheres, lambda lens: lens], ids=["spherical", "aspheric"])
def test_real_rays_keep_to_the_third_order(shape, seed, stop):
    """All five aberrations over pupil and field: the error of the sums falls with the fifth power of the scale."""
    pupil = 0.8 * sobol_disc(32, 0)  # real rays through the rim of the paraxial pupil may miss the rim of the stop
    px, py = pupil.unbind(-1)
    square = px**2 + py**2
    residuals, sizes = [], []
    for scale in (1.0, 0.5):
        lens = focused(shape(replace(random_lens(seed), stop=stop)), 0.05 * scale)
        view = view_at(scale * f64([0.0, 0.02, 0.04]))
        field = (view.radii / view.radii.max())[:, None]
        s1, s2, s3, s4, s5, *_ = totals(seidel_sums(lens, view))
        slope_x = s1 * square * px / 2 + s2 * field * px * py + (s3 + s4) * field**2 * px / 2
        slope_y = s1 * square * py / 2 + s2 * field * (square + 2 * py**2) / 2 + (3 * s3 + s4) * field**2 * py / 2
        slope_y = slope_y + s5 * field**3 / 2
        expected = torch.stack([slope_x, slope_y], -1) / last_angle(lens)
        ideal = view.tangents * paraxial(lens, REFERENCE).efl
        spots = spot_diagram(trace_fields(lens, view, pupil), ideal)[:, 0]
        residuals.append(float((spots - expected).abs().max()))
        sizes.append(float(spots.abs().max()))
    assert residuals[0] < 0.05 * sizes[0]
    assert residuals[0] / residuals[1] == pytest.approx(32, rel=0.05)
    assert sizes[0] / sizes[1] == pytest.approx(8, rel=0.1)


def test_a_conic_by_its_power_series_is_the_same_surface():
    """c r^2 / 2 + (1 + k) c^3 r^4 / 8 as alpha_2 and alpha_4 of a plane: both have the same osculating sphere."""
    lens = focused(random_lens(1), 0.1)
    c, alpha = lens.curvature, lens.alpha.clone()
    alpha[:, 0] += c / 2
    alpha[:, 1] += (1 + lens.conic) * c**3 / 8
    series = replace(lens, curvature=0 * c, conic=f64([5.0] * 5), alpha=alpha)
    view = view_at([0.2], WAVELENGTHS)
    expected, sums = (vars(seidel_sums(x, view)) for x in (lens, series))
    for name, values in expected.items():
        torch.testing.assert_close(sums[name], values, rtol=1e-12, atol=1e-15, msg=name)
        assert float(values.abs().max()) > 0


def test_a_hyperboloid_has_no_spherical_aberration():
    """Behind glass, k = -n^2 images the axis perfectly."""
    n = float(make_lens([0.0], [1.0], ("COC",)).refractive_indices((REFERENCE,))[1, 0])
    for conic, perfect in ((-(n**2), True), (0.0, False)):
        lens = make_lens([0.0, -0.4], [1.0, 2.0], ("COC", "air"), conic=[0.0, conic], semi_diameter=[0.5, torch.inf])
        spherical = seidel_sums(lens, view_at([0.1])).spherical
        assert bool(spherical.sum().abs() < 1e-15) is perfect and float(spherical.abs().max()) < 1


@pytest.mark.parametrize("bending", [-1.0, 0.0, 0.7])
def test_a_thin_lens_at_its_stop(bending):
    """S_III = H^2 f, S_IV = H^2 f / n, S_V = 0, C_I = y^2 f / V, C_II = 0 for any bending, f the power."""
    power, y, tangent = 0.3, 0.2, 0.3
    red, n, blue = (float(v) for v in make_lens([0.0], [1.0], ("COC",)).refractive_indices(WAVELENGTHS)[1])
    curvature = power / (n - 1) / 2 * (f64([1.0, -1.0]) + bending)
    lens = make_lens(curvature, [0.0, 1 / power], ("COC", "air"), semi_diameter=[y, torch.inf])
    _, _, s3, s4, s5, c1, c2 = (float(v) for v in totals(seidel_sums(lens, view_at([tangent], WAVELENGTHS))))
    h = y * tangent
    assert s3 == pytest.approx(h**2 * power, rel=1e-12)
    assert s4 == pytest.approx(h**2 * power / n, rel=1e-12)
    assert s5 == pytest.approx(0, abs=1e-15)
    assert c1 == pytest.approx(y**2 * power * (blue - red) / (n - 1), rel=1e-12)
    assert c2 == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_shifting_the_stop(seed):
    """The classical stop-shift equations, surface by surface; S_I, S_IV and C_I do not depend on the stop.

    Q is the change of yb / y and is the same on every surface (Welford 1986, chapter 8).
    """
    view = view_at([0.2], WAVELENGTHS)
    first, second = (focused(replace(random_lens(seed), stop=stop), 0.1) for stop in (0, 3))
    q = -0.2 * (paraxial(second, REFERENCE).entrance_pupil_z - paraxial(first, REFERENCE).entrance_pupil_z) / 0.1
    s1, s2, s3, s4, s5, c1, c2 = vars(seidel_sums(first, view)).values()
    expected = SeidelSums(
        s1,
        s2 + q * s1,
        s3 + 2 * q * s2 + q**2 * s1,
        s4,
        s5 + q * (3 * s3 + s4) + 3 * q**2 * s2 + q**3 * s1,
        c1,
        c2 + q * c1,
    )
    sums = seidel_sums(second, view)
    for name, values in vars(expected).items():
        torch.testing.assert_close(getattr(sums, name), values, rtol=1e-10, atol=1e-14, msg=name)


@pytest.mark.parametrize("stop", [0, 3])
@pytest.mark.parametrize("seed", range(3))
def test_colour_sums_are_those_of_close_wavelengths(seed, stop):
    """Paraxial rays of two colours through the same pupil point miss each other on the image by C / (n' u')."""
    wavelengths = (REFERENCE + 1e-4, REFERENCE, REFERENCE - 1e-4)
    lens = focused(replace(random_lens(seed), stop=stop), 0.1)
    *_, axial, lateral = totals(seidel_sums(lens, view_at([0.2], wavelengths)))
    first_order = paraxial(lens, REFERENCE)
    marginal = torch.stack([first_order.entrance_pupil_radius, torch.zeros_like(first_order.efl)])
    chief = torch.stack([-0.2 * first_order.entrance_pupil_z, f64(0.2)])
    heights = []
    for wavelength in (min(wavelengths), max(wavelengths)):
        indices = lens.refractive_indices((wavelength,))[:, 0]
        y, angles = paraxial_ray(*powers_and_thicknesses(lens, indices), *torch.stack([marginal, chief], -1))
        heights.append(y[-1] + angles[-1] * lens.thickness[-1])
    difference = heights[0] - heights[1]
    torch.testing.assert_close(difference, torch.stack([axial, lateral]) / last_angle(lens), rtol=1e-3, atol=0)


# ---- field curvature


@pytest.mark.parametrize("stop", [0, 2])
@pytest.mark.parametrize("seed", range(4))
def test_focus_is_where_neighbours_meet_the_chief_ray(seed, stop):
    """Rays 1e-4 of the pupil on both sides of the chief ray cross it there, in and across the meridian."""
    lens = focused(replace(random_lens(seed), stop=stop), 0.2)
    view = view_at([0.0, 0.1, 0.3])
    step = 1e-4
    rays = trace_fields(lens, view, step * f64([[0, 1], [0, -1], [1, 0], [-1, 0]]))
    assert rays.valid.all()
    points, slopes = torch.stack([rays.x, rays.y])[:, :, 0], torch.stack([rays.l, rays.m])[:, :, 0] / rays.n[:, 0]
    for focus, axis, first in zip(field_curvature(lens, view), (1, 0), (0, 2), strict=True):
        apart = points[axis, :, first] - points[axis, :, first + 1]
        opening = slopes[axis, :, first] - slopes[axis, :, first + 1]
        torch.testing.assert_close(focus, -apart / opening, rtol=1e-6, atol=1e-6)
        assert float(focus[2].abs()) > 1e-3
    torch.testing.assert_close(*(v[0] for v in field_curvature(lens, view)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_focus_of_small_fields_is_that_of_the_third_order(seed):
    """-(3 S_III + S_IV) / (2 n' u'^2) and -(S_III + S_IV) / (2 n' u'^2); at S_III = 0 only S_IV remains."""
    lens, view = focused(random_lens(seed), 0.1), view_at([3e-3])
    _, _, s3, s4, *_ = totals(seidel_sums(lens, view))
    tangential, sagittal = (float(v) for v in field_curvature(lens, view))
    square = 2 * float(last_angle(lens)) ** 2
    assert tangential == pytest.approx(float(-(3 * s3 + s4)) / square, rel=1e-3)
    assert sagittal == pytest.approx(float(-(s3 + s4)) / square, rel=1e-3)
    assert 3 * sagittal - tangential == pytest.approx(float(-2 * s4) / square, rel=1e-2)


def test_a_stop_at_the_centre_of_curvature_makes_no_astigmatism():
    """All foci lie on a sphere around the centre, through the focus on the axis."""
    lens = make_lens([0.0, -0.5], [2.0, 5.0], ("air", "COC"), semi_diameter=[1e-3, torch.inf])
    tangents = [0.0, 0.2, 0.7]
    tangential, sagittal = field_curvature(lens, view_at(tangents))
    torch.testing.assert_close(tangential, sagittal, rtol=1e-12, atol=1e-12)
    from_centre = tangential + 7.0
    expected = from_centre[0] * f64([math.cos(math.atan(t)) for t in tangents])
    torch.testing.assert_close(from_centre, expected, rtol=1e-12, atol=0)


def test_a_lost_chief_ray_has_no_focus_and_parallel_neighbours_an_infinite_one():
    lens = make_lens([0.0, 0.3], [1.0, 2.0], ("air", "COC"), semi_diameter=[0.1, 0.5])
    tangential, sagittal = field_curvature(lens, view_at([0.0, 0.4, 0.6]))
    assert tangential.isnan().tolist() == sagittal.isnan().tolist() == [False, False, True]
    assert chief_rays(lens, view_at([0.6])).valid.sum() == 0
    plate = make_lens([0.0, 0.0], [1.0, 2.0], ("COC", "air"), semi_diameter=[0.1, torch.inf])
    assert all(v.isinf().all() for v in field_curvature(plate, view_at([0.0, 0.4])))


@pytest.mark.parametrize("stop", [0, 2])
@pytest.mark.parametrize("name", ["curvature", "conic", "alpha", "thickness"])
def test_gradients_of_the_foci_are_those_of_differences(name, stop):
    """The chief ray moves with the lens; a field with a lost chief ray contributes no gradient."""
    lens = focused(replace(random_lens(1), stop=stop), 0.2)
    lens.semi_diameter[4] = 1.0
    view = view_at([0.0, 0.1, 0.3, 2.0])
    assert chief_rays(lens, view).valid[:, 0, 0].tolist() == [True, True, True, False]

    def foci(values: torch.Tensor) -> torch.Tensor:
        return torch.stack(field_curvature(replace(lens, **{name: values}), view))[:, :3]

    values = getattr(lens, name).clone().requires_grad_()
    focus = foci(values)
    gradient = torch.stack([torch.autograd.grad(v, values, retain_graph=True)[0] for v in focus.flatten()])
    expected = difference(lambda v: foci(v).flatten(), values.detach(), 1e-4)
    assert float(expected.abs().max()) > 1e-3
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=1e-6)
