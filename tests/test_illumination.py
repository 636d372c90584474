"""Relative illumination: stops at a centre of curvature, sharp and aberrated lenses, and mounts that vignette."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy
import pytest
import torch
from examples import HEADLINE, f64, make_lens, random_lens, view_at

import tasklens
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import chief_points, clear_semi_diameters
from tasklens.optics.rays import launch
from tasklens.optics.tracing.trace import trace

DATA = Path(__file__).parent / "data"


on_diagonal = partial(view_at, along=(0.6, 0.8))  # of the sensor


@pytest.fixture(scope="module")
def clear():
    return replace(random_lens(2), semi_diameter=f64([0.3, *[torch.inf] * 4]))


@pytest.mark.parametrize(
    "path, distance", [(DATA / "sharp_quadruplet.yaml", 20.0), (HEADLINE / "doublet-tasklens.yaml", math.inf)]
)
def test_it_is_the_density_of_rays(path, distance):
    """Rays of a uniform object, counted in rings of the image, sharp or with a wide halo: within 1.5 %.

    The stop is in front. A ray counts by the etendue of its sample: areas of object and stop, and cos^4 / z^2.
    """
    lens, view = tasklens.load_lens(path)
    view = replace(view.in_reference(), object_vergence=1 / distance)  # without refocusing
    fields = view.along_y(torch.linspace(0.4, 1.7, 14, dtype=torch.float64))
    light, heights = relative_illumination(lens, fields), chief_points(lens, fields)[:, 1]
    u, v, w = torch.quasirandom.SobolEngine(3, scramble=True, seed=0).draw(1 << 19, dtype=torch.float64).unbind(-1)
    widest, radius = 1.7 * float(view.radii.max()) / view.efl, float(lens.semi_diameter[lens.stop])
    tangent, rho, angle = widest * u.sqrt(), radius * v.sqrt(), 2 * math.pi * w
    stop = torch.stack([rho * torch.cos(angle), rho * torch.sin(angle)], -1)
    z = float(lens.vertices[lens.stop])
    slope = torch.stack([torch.zeros_like(tangent), tangent], -1)
    if math.isfinite(distance):  # from the object point at -tangent (distance + z), as seen from the stop
        slope = (stop + slope * (distance + z)) / (distance + z)
    n = torch.rsqrt(1 + slope.square().sum(-1))
    x, y = (stop - z * slope).unbind(-1)
    start = launch(x, y, torch.zeros_like(x), slope[:, 0] * n, slope[:, 1] * n, n)
    start = replace(start, **{name: value[None] for name, value in vars(start).items()})
    rays = trace(lens, start, lens.refractive_indices(view.wavelengths_um))
    arrives, r = rays.valid[0], torch.hypot(rays.x[0], rays.y[0])
    edges = torch.linspace(0.3, 1.8, 16, dtype=torch.float64)
    counted = torch.histogram(r[arrives], edges, weight=(n**4)[arrives]).hist / edges.square().diff()
    middle = (edges[1:] + edges[:-1]) / 2
    expected = f64(numpy.interp(heights.numpy(), middle.numpy(), counted.numpy()))
    torch.testing.assert_close(light / light[0], expected / expected[0], rtol=0.015, atol=0)


@pytest.mark.parametrize("shift", [0.3, 1.6])
def test_a_mount_cuts_what_two_circles_do_not_share(shift):
    """A hole at a distance from a small stop: the remaining light is the overlap of two shifted circles."""
    a, hole, distance, f = 1e-3, 1.2e-3, 0.05, 3.0
    lens = make_lens([0.0, 0.0, 1 / f], [distance, 0.0, 1.0], ("air", "air", "COC"), semi_diameter=[a, hole, torch.inf])
    d = shift * a
    angle_a = math.acos(max(-1.0, min(1.0, (d * d + a * a - hole * hole) / (2 * d * a))))
    angle_h = math.acos(max(-1.0, min(1.0, (d * d + hole * hole - a * a) / (2 * d * hole))))
    corner = max(0.0, (-d + a + hole) * (d + a - hole) * (d - a + hole) * (d + a + hole))
    overlap = (a * a * angle_a + hole * hole * angle_h - 0.5 * math.sqrt(corner)) / (math.pi * a * a)
    overlap = overlap if d > hole - a else 1.0
    view = on_diagonal([d / distance])
    whole = relative_illumination(replace(lens, semi_diameter=f64([a, torch.inf, torch.inf])), view)
    share = relative_illumination(lens, view) / whole
    assert float(share) == pytest.approx(overlap, abs=4e-3)


def test_a_field_that_is_cut_off_is_dark_and_the_axis_is_not(clear):
    """The last surface passes only the axial beam: a far field is dark, a near field partly vignetted."""
    used = clear_semi_diameters(clear, on_diagonal([0.0]))
    semi = clear.semi_diameter.clone()
    semi[-1] = used[-1] * 1.001
    view = on_diagonal([0.0, 0.1, 0.6])
    cut = relative_illumination(replace(clear, semi_diameter=semi), view)
    whole = relative_illumination(clear, view)
    assert float(cut[0]) == pytest.approx(1, abs=1e-12)
    assert 0.2 * float(whole[1]) < float(cut[1]) < 0.98 * float(whole[1])
    assert float(cut[2]) == 0 and float(whole[2]) > 0


def test_a_lens_that_is_dark_on_the_axis_has_no_relative_illumination(clear):
    blocked = replace(clear, semi_diameter=clear.semi_diameter.clone())
    blocked.semi_diameter[2] = 0.0
    assert relative_illumination(blocked, on_diagonal([0.0, 0.1])).tolist() == [0, 0]
