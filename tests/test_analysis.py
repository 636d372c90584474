"""Spots, ray fans, distortion, MTF and clear apertures, from constructed or individually traced rays."""

import math
from dataclasses import replace

import pytest
import torch
from examples import cooke_triplet, f64, lens_and_view, rays_on_image

from tasklens.optics.analysis.focus import refocus
from tasklens.optics.analysis.mtf import geometric_mtf
from tasklens.optics.analysis.pupil import rim, sobol_disc
from tasklens.optics.analysis.spots import (
    centroid,
    chief_points,
    clear_semi_diameters,
    distortion,
    encircled_energy_radius,
    ray_fans,
    rms_spot_radius,
    spot_diagram,
    trace_fields,
)
from tasklens.optics.rays import RayStatus
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError

ORIGIN = f64([[0.0, 0.0]])
ALONG_Y = f64([[0.0, 1.0]])


def test_spot_figures_of_a_ring():
    """n points on a circle: RMS and every encircled-energy radius are its radius, the centroid its centre."""
    angle = torch.arange(8, dtype=torch.float64) * math.pi / 4
    rays = rays_on_image((2 + 0.5 * torch.cos(angle))[None, None], (1 + 0.5 * torch.sin(angle))[None, None])
    middle = centroid(rays)
    torch.testing.assert_close(middle, f64([[2.0, 1.0]]), rtol=0, atol=1e-15)
    for radius in (rms_spot_radius(rays, middle), *(encircled_energy_radius(rays, middle, q) for q in (0.1, 0.5, 1))):
        assert float(radius) == pytest.approx(0.5, abs=1e-14)
    # about a point at distance d: RMS^2 = 0.5^2 + d^2
    assert float(rms_spot_radius(rays, f64([[2.0, 2.2]]))) == pytest.approx(math.hypot(0.5, 1.2), abs=1e-14)


def test_rms_is_a_root_of_a_mean_square_and_lost_rays_count_in_energy_only():
    """Rays at 1, 2 and 3 from the centre, a fourth lost: RMS sqrt(14 / 3), half of the launched light within 2."""
    rays = rays_on_image([[[1.0, -2.0, 3.0, 0.0]]], [[[0.0] * 4]], torch.tensor([[[True, True, True, False]]]))
    assert float(rms_spot_radius(rays, ORIGIN)) == pytest.approx(math.sqrt(14 / 3), rel=1e-15)
    start = rays.x[0, 0, 0].item(), rays.y[0, 0, 0].item()
    moved = replace(rays, x=rays.x.clone().requires_grad_())
    rms_spot_radius(moved, f64([start])).sum().backward()  # one ray is at the centre itself
    assert moved.x.grad.isfinite().all() and moved.x.grad.any()
    assert float(encircled_energy_radius(rays, ORIGIN, 0.5)) == 2
    assert float(encircled_energy_radius(rays, ORIGIN, 0.75)) == 3
    assert math.isinf(float(encircled_energy_radius(rays, ORIGIN, 0.8)))


@pytest.mark.parametrize("count", [10, 30, 70])
def test_encircled_energy_counts_exactly(count):
    """Rays at 1 .. N from the centre: k of N rays lie within k, whatever k / N rounds to."""
    x = torch.arange(1, count + 1, dtype=torch.float64)[None, None]
    rays = rays_on_image(x, torch.zeros_like(x))
    for k in range(1, 11):
        assert float(encircled_energy_radius(rays, ORIGIN, k / 10)) == k * count // 10


def test_a_field_without_rays_is_no_perfect_spot():
    rays = rays_on_image([[[0.0, 0.0]]], [[[0.0, 0.0]]], torch.zeros(1, 1, 2, dtype=torch.bool))
    assert math.isinf(float(rms_spot_radius(rays, centroid(rays))))
    assert spot_diagram(rays, ORIGIN).isnan().all()
    assert all(float(v) == 0 for v in geometric_mtf(rays, ALONG_Y, [0.0]))


def test_spot_diagram_is_about_its_centre_and_without_lost_rays():
    points = torch.randn(2, 3, 2, 50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    valid = torch.rand(3, 2, 50, generator=torch.Generator().manual_seed(1)) < 0.8
    rays = rays_on_image(*points, valid)
    spots = spot_diagram(rays, centroid(rays))
    assert torch.equal(spots.isnan().any(-1), ~valid)
    torch.testing.assert_close(spots.nanmean((1, 2)), torch.zeros(3, 2, dtype=torch.float64), rtol=0, atol=1e-15)
    torch.testing.assert_close(spots.square().sum(-1).nanmean((1, 2)).sqrt(), rms_spot_radius(rays, centroid(rays)))


@pytest.fixture(scope="module")
def lens():
    return lens_and_view()


def test_clear_semi_diameters_pass_all_light_and_not_more(lens):
    """A lens with these apertures loses no rim ray; with a slightly smaller aperture on any surface it does."""
    lens, view = lens
    apertures = clear_semi_diameters(lens, view)
    assert trace_fields(replace(lens, semi_diameter=apertures), view, rim(64)).valid.all()
    for i in range(1, len(apertures)):
        cut = apertures.clone()
        cut[i] *= 0.999
        rays = trace_fields(replace(lens, semi_diameter=cut), view, rim(64))
        assert set(rays.lost_at[~rays.valid].tolist()) == {i}
        assert (rays.status[~rays.valid] == RayStatus.VIGNETTED).all()


def test_ray_fans_are_the_real_rays_of_the_field_turned(lens):
    """Ray errors along and across the field, for pupil points along and across it, in any meridian."""
    lens, view = lens
    pupil, tangential, sagittal = ray_fans(lens, view, 9)
    chief = chief_points(lens, view)
    for f, along in enumerate(view.directions):
        across = torch.stack([along[1], -along[0]])  # right-handed: (across, along) are (x, y) turned
        for direction, fan in ((along, tangential), (across, sagittal)):
            one_field = replace(view, fields=view.fields[f : f + 1])
            rays = trace_fields(lens, one_field, pupil[:, None] * direction)
            errors = spot_diagram(rays, chief[f : f + 1])[0]
            expected = torch.stack([errors @ across, errors @ along], -1)
            torch.testing.assert_close(fan[f], expected, rtol=0, atol=1e-13)
    assert float(tangential[:, 1, 4].abs().max()) == 0  # the chief ray itself
    torch.testing.assert_close(tangential[0, ..., 1], sagittal[0, ..., 0], rtol=0, atol=1e-14)  # on the axis


def test_a_lost_ray_has_no_place_in_a_fan(lens):
    lens, view = lens
    narrow = replace(lens, semi_diameter=lens.semi_diameter.clone())
    narrow.semi_diameter[1] = 0.2
    _, tangential, _ = ray_fans(narrow, replace(view, fields=view.fields[:1]), 5)
    assert tangential[0, 0, :, 0].isnan().tolist() == [True, False, False, False, True]


def test_distortion_is_signed_and_along_the_field():
    """10 % short: -0.1, a barrel; upside down: -2; sideways and on the axis: none."""
    fields = f64([[3.0, 4.0], [3.0, 4.0], [3.0, 4.0], [0.0, 0.0]])
    chief = f64([[2.7, 3.6], [-3.0, -4.0], [3.0 - 0.4, 4.0 + 0.3], [0.1, 0.0]])
    torch.testing.assert_close(distortion(fields, chief), f64([-0.1, -2.0, 0.0, 0.0]), rtol=0, atol=1e-15)


# ---- geometric MTF

FREQUENCIES = f64([0.0, 10.0, 35.0, 80.0, 140.0])  # [cycles/mm]


def test_mtf_of_two_points():
    """Half of the light at each end of a line of length d along the field: |cos(pi f d)| along it, 1 across it."""
    along = f64([0.6, -0.8])
    d = 7e-3
    ends = f64([2.0, 1.0]) + d / 2 * f64([[-1.0], [1.0]]) * along
    tangential, sagittal = geometric_mtf(rays_on_image(*ends.T[:, None, None]), along[None], FREQUENCIES)
    torch.testing.assert_close(tangential[0], torch.cos(math.pi * d * FREQUENCIES).abs(), rtol=0, atol=1e-11)
    torch.testing.assert_close(sagittal[0], torch.ones(5, dtype=torch.float64), rtol=0, atol=1e-11)


def test_mtf_is_that_of_the_light_of_all_colours():
    """Each colour is a perfect point; a lateral colour of d leaves |cos(pi f d)|."""
    d = 5e-3
    rays = rays_on_image(torch.zeros(1, 2, 8), f64([0.0, d])[None, :, None].expand(1, 2, 8))
    tangential, _ = geometric_mtf(rays, ALONG_Y, FREQUENCIES)
    torch.testing.assert_close(tangential[0], torch.cos(math.pi * d * FREQUENCIES).abs(), rtol=0, atol=1e-13)


def test_losing_rays_gains_no_contrast():
    """Only the core of a disc arrives: the MTF begins at the valid fraction and stays below it."""
    points = 6e-3 * sobol_disc(1024, 0)
    core = points.norm(dim=-1) < 3e-3
    tangential, _ = geometric_mtf(rays_on_image(*points.T[:, None, None], core[None, None]), ALONG_Y, FREQUENCIES)
    alone, _ = geometric_mtf(rays_on_image(*points[core].T[:, None, None]), ALONG_Y, FREQUENCIES)
    share = float(core.double().mean())
    assert 0.2 < share < 0.3
    torch.testing.assert_close(tangential, share * alone, rtol=1e-12, atol=0)


@pytest.mark.parametrize("by", ["mtf", "spot"])
def test_a_field_without_light_does_not_keep_a_lens_out_of_focus(by):
    """No ray of a field at 60 mm passes: the focus is the focus of the axis; without any light there is none."""
    lens = cooke_triplet()
    both = View(f64([[0.0, 0.0], [0.0, 60.0]]), 50.0, (0.5876,), 5.0, 31)
    axis = replace(both, fields=both.fields[:1])
    focused, on_axis = (refocus(lens, view, by).thickness[-1] for view in (both, axis))
    assert focused == on_axis != lens.thickness[-1]
    with pytest.raises(InputError, match="no ray of any field reaches the image"):
        refocus(lens, replace(both, fields=both.fields[1:]), by)
