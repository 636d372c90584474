"""Relative illumination: stops at a centre of curvature, clear lenses, and mounts that vignette."""

import math
from dataclasses import replace

import pytest
import torch
from examples import f64, make_lens, random_lens

from tasklens.optics.analysis.aberrations import field_curvature
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import rim
from tasklens.optics.analysis.spots import chief_points, clear_semi_diameters, trace_fields
from tasklens.optics.view import View


def view_at(tangents) -> View:
    """Fields along the diagonal of the sensor with these tangents, for a pinhole of 1 mm."""
    tangents = f64(tangents)
    return View(torch.stack([0.6 * tangents, 0.8 * tangents], -1), 1.0, (0.5893,), 9.0, 31)


@pytest.fixture(scope="module")
def clear():
    return replace(random_lens(2), semi_diameter=f64([0.3, *[torch.inf] * 4]))


def test_a_stop_at_the_centre_of_curvature():
    """Every field sees the same surface through a foreshortened stop: cos^2, one cos from the stop, one from (l, m).

    The other two factors of cos^4 come from a flat image; the image of a monocentric lens is curved.
    """
    lens = make_lens([0.0, -0.5], [2.0, 5.0], ("air", "COC"), semi_diameter=[1e-3, torch.inf])
    tangents = [0.0, 0.1, 0.4, 1.0]
    expected = f64([1 / (1 + t**2) for t in tangents])
    torch.testing.assert_close(relative_illumination(lens, view_at(tangents)), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("seed", range(3))
def test_a_small_pupil_keeps_etendue(seed):
    """E / E0 = f^2 sin cos / (h_S dh_T / dtheta), or cos^4 for a flat, sharp image with h = f tan(theta).

    h_S and h_T are heights of the chief ray in the planes of the sagittal and of the tangential focus of the field.
    """
    lens = replace(random_lens(seed), semi_diameter=f64([1e-4, *[torch.inf] * 4]))
    f = float(paraxial(lens, 0.5893).efl)
    for angle in (0.1, 0.3):
        view = view_at([math.tan(angle)])
        tangential, sagittal = field_curvature(lens, view)

        def height(angle: float, shift: torch.Tensor) -> float:
            moved = replace(lens, thickness=lens.thickness + f64([0, 0, 0, 0, float(shift)]))
            return float(chief_points(moved, view_at([math.tan(angle)])) @ f64([0.6, 0.8]))

        step = 1e-4
        derivative = (height(angle + step, tangential) - height(angle - step, tangential)) / (2 * step)
        expected = f**2 * math.sin(angle) * math.cos(angle) / abs(height(angle, sagittal) * derivative)
        assert float(relative_illumination(lens, view)) == pytest.approx(expected, rel=1e-6)


def test_without_clipping_it_is_the_area_inside_the_rim(clear):
    """Area by Green's theorem over many rim rays, for fields in any direction."""
    view = view_at([0.0, 0.1, 0.2, 0.3])
    rays = trace_fields(clear, view, rim(4096))
    l, m = rays.l[:, 0], rays.m[:, 0]
    area = 0.5 * (l * m.roll(-1, -1) - m * l.roll(-1, -1)).sum(-1)
    torch.testing.assert_close(relative_illumination(clear, view), area / area[0], rtol=1e-7, atol=0)


@pytest.mark.parametrize("shift", [0.3, 1.0, 1.6, 1.9])
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
    view = view_at([d / distance])
    whole = relative_illumination(replace(lens, semi_diameter=f64([a, torch.inf, torch.inf])), view)
    share = relative_illumination(lens, view) / whole
    assert float(share) == pytest.approx(overlap, abs=4e-3)


def test_a_field_that_is_cut_off_is_dark_and_the_axis_is_not(clear):
    """The last surface passes only the axial beam: a far field is dark, a near field partly vignetted."""
    used = clear_semi_diameters(clear, view_at([0.0]))
    semi = clear.semi_diameter.clone()
    semi[-1] = used[-1] * 1.001
    view = view_at([0.0, 0.1, 0.6])
    cut = relative_illumination(replace(clear, semi_diameter=semi), view)
    whole = relative_illumination(clear, view)
    assert float(cut[0]) == pytest.approx(1, abs=1e-12)
    assert 0.2 * float(whole[1]) < float(cut[1]) < 0.98 * float(whole[1])
    assert float(cut[2]) == 0 and float(whole[2]) > 0


def test_a_lens_that_is_dark_on_the_axis_has_no_relative_illumination(clear):
    blocked = replace(clear, semi_diameter=clear.semi_diameter.clone())
    blocked.semi_diameter[2] = 0.0
    assert relative_illumination(blocked, view_at([0.0, 0.1])).tolist() == [0, 0]
