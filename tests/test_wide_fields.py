"""Wide fields: a chief ray that exists is found, by comparison with a scan over the launch height."""

import math
from dataclasses import replace

import numpy
import pytest
import torch
from examples import difference, f64, make_lens

from tasklens.materials.material import model_glass
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import launch_fields, rim, sobol_disc
from tasklens.optics.analysis.spots import chief_rays
from tasklens.optics.io.prescribed_fields import field_tangents
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.rays import launch
from tasklens.optics.tracing.trace import trace, trace_full
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError

ANGLES = (0.0, 60.0, 78.6, 85.0, 88.0)
SEEDS = 0, 5
CENTRE = torch.zeros(1, 2, dtype=torch.float64)


def view_at(degrees, vergence: float = 0.0) -> View:
    """Fields across the diagonal, for a pinhole of 1 mm, in one wavelength."""
    tangent = torch.tan(torch.deg2rad(f64(degrees)))
    return View(torch.stack([0.6 * tangent, -0.8 * tangent], -1), 1.0, (0.5876,), 1.8, 31, vergence)


def fisheye(seed: int) -> Lens:
    """A meniscus, a negative and a positive element, the stop, a positive element; odd seeds are aspheres."""
    random = numpy.random.default_rng(seed)
    between = random.uniform
    radii = [between(15, 40), between(4, 8), between(-40, -8), between(4, 9), between(5, 15), between(-30, -8)]
    curvature = [*(1 / radius for radius in radii), 0.0, 0.1, -0.1]
    thickness = [1.5, between(4, 10), 1.2, between(2, 8), 4.0, between(0.5, 12), 0.5, 3.0, 12.0]
    glass = model_glass(1.6, 60.0, 0.0)
    media = (glass, "air", glass, "air", glass, "air", "air", glass, "air")
    conic, alpha = numpy.zeros(9), numpy.zeros((9, 2))
    if seed % 2:
        conic[:6], alpha[:6, 1] = between(-0.8, 0.3, 6), between(-3e-6, 3e-6, 6)
    stop = [math.inf] * 6 + [0.2] + [math.inf] * 2
    return make_lens(curvature, thickness, media, conic=conic, alpha=alpha, semi_diameter=stop, stop=6)


def stop_heights(lens: Lens, heights: numpy.ndarray, angle: float) -> numpy.ndarray:
    """Trace meridional rays from heights of the first vertex plane to their heights at the stop; NaN for lost rays."""
    y = f64(heights)[None]
    start = launch(0 * y, y, 0 * y, 0 * y, 0 * y + math.sin(angle), 0 * y + math.cos(angle))
    at_stop = trace_full(lens.with_open_apertures(), start, lens.refractive_indices((0.5876,)))[1][lens.stop]
    return torch.where(at_stop.valid, at_stop.y, torch.nan)[0].numpy()


def scanned_heights(lens: Lens, angle: float) -> list[float]:
    """Launch heights of all chief rays, by a scan: rays that pass up to 12 mm from the first vertex."""
    h = numpy.linspace(-12, 12, 3001) / math.cos(angle)
    y = stop_heights(lens, h, angle)
    between = ((y[1:] > 0) != (y[:-1] > 0)) & numpy.isfinite(y[1:]) & numpy.isfinite(y[:-1])
    return h[:-1][between].tolist()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_chief_ray_that_exists_is_found(seed):
    """At every angle up to 88 degrees it passes the centre of the stop; a scan finds none that is not found."""
    lens = fisheye(seed)
    rays = launch_fields(lens, view_at(ANGLES), CENTRE)
    heights = (0.6 * rays.x - 0.8 * rays.y)[:, 0, 0].tolist()
    for height, found, angle in zip(heights, rays.valid[:, 0, 0].tolist(), map(math.radians, ANGLES), strict=True):
        assert found or not scanned_heights(lens, angle), angle
        if found:
            assert abs(float(stop_heights(lens, numpy.array([height]), angle)[0])) < 1e-9


FAR = 5  # the seed of an asphere with light at every angle


@pytest.mark.parametrize("points", [rim(16), sobol_disc(512, seed=2)], ids=len)
def test_the_whole_pupil_follows_its_chief_ray(points):
    lens, view = fisheye(FAR), view_at(ANGLES)
    rays = launch_fields(lens, view, points)
    assert rays.valid.double().mean() > 0.9
    _, behind = trace_full(lens.with_open_apertures(), rays, lens.refractive_indices((0.5876,)))
    at_stop, radius = behind[lens.stop], lens.semi_diameter[lens.stop]
    error = torch.hypot(at_stop.x - radius * points[:, 0], at_stop.y - radius * points[:, 1])
    assert float(error[rays.valid].max()) < 1e-11


def test_derivatives_of_chief_rays_at_80_degrees():
    """Along a change of all thicknesses."""
    lens, view = fisheye(FAR), view_at([80.0])
    along = torch.linspace(-1, 1, 9, dtype=torch.float64)

    def image(step: torch.Tensor) -> torch.Tensor:
        changed = replace(lens, thickness=lens.thickness + step * along)
        rays = trace(changed, launch_fields(changed, view, CENTRE), changed.refractive_indices((0.5876,)))
        return torch.stack([rays.x, rays.y])

    expected = difference(image, f64(0.0), 1e-5)
    actual = torch.autograd.functional.jacobian(image, f64(0.0)).reshape(expected.shape)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


def test_a_near_object():
    """The chief ray passes the centre of the stop, and begins at its object point."""
    lens, view = fisheye(FAR), view_at([0.0, 60.0, 75.0], vergence=1 / 200)
    rays = launch_fields(lens, view, CENTRE)
    assert rays.valid.all()
    _, behind = trace_full(lens, rays, lens.refractive_indices((0.5876,)))
    assert float(torch.hypot(behind[lens.stop].x, behind[lens.stop].y).max()) < 1e-11


def test_the_field_of_an_image_height():
    """It is that of the chief ray, as far as the lens has an image; beyond it there is none."""
    lens, angle = fisheye(FAR), 89.3
    efl = float(paraxial(lens, 0.5876).efl)
    field = f64([[0.0, efl * math.tan(math.radians(angle))]])
    height = abs(float(chief_rays(lens, View(field, efl, (0.5876,), 1.8, 31)).y))
    source = Prescription(lens, fields=("real_image_height_mm", ((0.0, height),)))
    ((x, y),) = field_tangents(source, efl, 0.0, 0.5876).tolist()
    assert x == 0 and math.degrees(math.atan(y)) == pytest.approx(angle, abs=1e-6)
    with pytest.raises(InputError, match="no chief ray arrives at the image height"):
        field_tangents(replace(source, fields=("real_image_height_mm", ((0.0, 3 * height),))), efl, 0.0, 0.5876)
