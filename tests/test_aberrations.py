"""Seidel sums against real rays and textbook thin lenses; field curvature against rays next to the chief ray."""

import math
from dataclasses import replace

import pytest
import torch
from examples import WAVELENGTHS, assert_derivative, f64, make_lens, random_lens, view_at

from tasklens.optics.analysis.aberrations import field_curvature, seidel_sums
from tasklens.optics.analysis.object_points import image_scale
from tasklens.optics.analysis.paraxial import paraxial, paraxial_ray, powers_and_thicknesses
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_rays, trace_fields
from tasklens.optics.analysis.wavefront import path_differences
from tasklens.optics.lens import Lens

REFERENCE = WAVELENGTHS[1]


def focused(lens: Lens, pupil_radius: float, distance: float = math.inf) -> Lens:
    """The lens with its paraxial focus on the image plane and an entrance pupil of this radius."""
    lens = replace(lens, semi_diameter=torch.ones_like(lens.semi_diameter))
    semi = torch.full_like(lens.semi_diameter, torch.inf)
    semi[lens.stop] = pupil_radius / paraxial(lens, REFERENCE).entrance_pupil_radius
    focus = field_curvature(lens, view_at([0.0], distance=distance))[0]
    return replace(lens, thickness=torch.cat([lens.thickness[:-1], lens.thickness[-1] + focus]), semi_diameter=semi)


def totals(sums: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
    return tuple(values.sum() for values in sums.values())


@pytest.mark.parametrize("seed, stop, distance", [(0, 0, math.inf), (4, 2, 20.0), (0, 4, math.inf)])
def test_real_rays_keep_to_the_third_order(seed, stop, distance):
    """W about the paraxial image point; the error of the sums falls with the sixth power of the scale."""
    pupil = 0.8 * sobol_disc(128, 0)  # real rays through the rim of the paraxial pupil may miss the rim of the stop
    px, py = pupil.unbind(-1)
    square = px**2 + py**2
    residuals, sizes = [], []
    for scale in (1.0, 0.5):
        lens = focused(replace(random_lens(seed), stop=stop), 0.05 * scale, distance)
        view = view_at(scale * f64([0.0, 0.02, 0.04]), distance=distance)
        s1, s2, s3, s4, s5, *_ = totals(seidel_sums(lens, view))
        h = (view.radii / view.radii.max())[:, None]
        expected = s1 * square**2 / 8 + s2 * h * square * py / 2 + s3 * h**2 * py**2 / 2
        expected = expected + (s3 + s4) * h**2 * square / 4 + s5 * h**3 * py / 2
        ideal = image_scale(lens, view) * paraxial(lens, REFERENCE).efl * view.tangents
        path_difference = 1e-3 * REFERENCE * path_differences(lens, view, pupil, ideal)[:, 0]
        residuals.append(float((path_difference - expected).abs().max()))
        sizes.append(float(path_difference.abs().max()))
    assert residuals[0] < 0.05 * sizes[0]
    assert residuals[0] / residuals[1] == pytest.approx(64, rel=0.1)
    assert sizes[0] / sizes[1] == pytest.approx(16, rel=0.1)


def test_shifting_the_stop():
    """The classical stop-shift equations, surface by surface; S_I, S_IV and C_I do not depend on the stop.

    Q is the change of yb / y and is the same on every surface (Welford 1986, chapter 8).
    """
    view = view_at([0.2], wavelengths=WAVELENGTHS)
    first, second = (focused(replace(random_lens(2), stop=stop), 0.1) for stop in (0, 3))
    q = -0.2 * (paraxial(second, REFERENCE).entrance_pupil_z - paraxial(first, REFERENCE).entrance_pupil_z) / 0.1
    s1, s2, s3, s4, s5, c1, c2 = seidel_sums(first, view).values()
    third = s3 + 2 * q * s2 + q**2 * s1
    fifth = s5 + q * (3 * s3 + s4) + 3 * q**2 * s2 + q**3 * s1
    expected = torch.stack([s1, s2 + q * s1, third, s4, fifth, c1, c2 + q * c1])
    sums = torch.stack([*seidel_sums(second, view).values()])
    torch.testing.assert_close(sums, expected, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("seed, stop", [(0, 0), (1, 3)])
def test_colour_sums_are_those_of_close_wavelengths(seed, stop):
    """Paraxial rays of two colours through the same pupil point miss each other on the image by C / (n' u')."""
    wavelengths = (REFERENCE + 1e-4, REFERENCE, REFERENCE - 1e-4)
    lens = focused(replace(random_lens(seed), stop=stop), 0.1)
    *_, axial, lateral = totals(seidel_sums(lens, view_at([0.2], wavelengths=wavelengths)))
    first_order = paraxial(lens, REFERENCE)
    marginal = torch.stack([first_order.entrance_pupil_radius, torch.zeros_like(first_order.efl)])
    chief = torch.stack([-0.2 * first_order.entrance_pupil_z, f64(0.2)])
    heights = []
    for wavelength in (min(wavelengths), max(wavelengths)):
        indices = lens.refractive_indices((wavelength,))[:, 0]
        y, angles = paraxial_ray(*powers_and_thicknesses(lens, indices), *torch.stack([marginal, chief], -1))
        heights.append(y[-1] + angles[-1] * lens.thickness[-1])
    last_angle = -first_order.entrance_pupil_radius * first_order.power  # n' u' of the marginal ray behind the lens
    torch.testing.assert_close(heights[0] - heights[1], torch.stack([axial, lateral]) / last_angle, rtol=1e-3, atol=0)


# ---- field curvature


@pytest.mark.parametrize("seed, stop, distance", [(0, 0, math.inf), (1, 2, 20.0), (0, 2, math.inf)])
def test_focus_is_where_neighbours_meet_the_chief_ray(seed, stop, distance):
    """Rays 1e-4 of the pupil on both sides of the chief ray cross it there, in and across the meridian."""
    lens = focused(replace(random_lens(seed), stop=stop), 0.2, distance)
    view = view_at([0.0, 0.1, 0.3], distance=distance)
    step = 1e-4
    rays = trace_fields(lens, view, step * f64([[0, 1], [0, -1], [1, 0], [-1, 0]]))
    assert rays.valid.all()
    points, slopes = torch.stack([rays.x, rays.y])[:, :, 0], torch.stack([rays.l, rays.m])[:, :, 0] / rays.n[:, 0]
    for focus, axis, first in zip(field_curvature(lens, view), (1, 0), (0, 2), strict=True):
        apart = points[axis, :, first] - points[axis, :, first + 1]
        opening = slopes[axis, :, first] - slopes[axis, :, first + 1]
        torch.testing.assert_close(focus, -apart / opening, rtol=1e-7, atol=1e-6)
        assert float(focus[2].abs()) > 1e-3
    torch.testing.assert_close(*(v[0] for v in field_curvature(lens, view)), rtol=0, atol=1e-12)


def test_a_lost_chief_ray_has_no_focus_and_parallel_neighbours_an_infinite_one():
    lens = make_lens([0.0, 0.3], [1.0, 2.0], ("air", "COC"), semi_diameter=[0.1, 0.5])
    tangential, sagittal = field_curvature(lens, view_at([0.0, 0.4, 0.6]))
    assert tangential.isnan().tolist() == sagittal.isnan().tolist() == [False, False, True]
    assert chief_rays(lens, view_at([0.6])).valid.sum() == 0
    plate = make_lens([0.0, 0.0], [1.0, 2.0], ("COC", "air"), semi_diameter=[0.1, torch.inf])
    assert all(v.isinf().all() for v in field_curvature(plate, view_at([0.0, 0.4])))


@pytest.mark.parametrize("name", ["curvature", "conic", "alpha", "thickness"])
def test_gradients_of_the_foci_are_those_of_differences(name):
    """The chief ray moves with the lens; a field with a lost chief ray has no gradient."""
    lens = focused(replace(random_lens(1), stop=2), 0.2)
    lens.semi_diameter[4] = 1.0
    view = view_at([0.0, 0.1, 0.3, 2.0])
    assert chief_rays(lens, view).valid[:, 0, 0].tolist() == [True, True, True, False]

    def foci(values: torch.Tensor) -> torch.Tensor:
        return torch.stack(field_curvature(replace(lens, **{name: values}), view))[:, :3].flatten()

    assert_derivative(foci, getattr(lens, name), 1e-4, seed=3, rtol=1e-7)
