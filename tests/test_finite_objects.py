"""Objects at a finite distance: perfect and thin lenses, derivatives, files, commands, and Optiland."""

import json
import math
from dataclasses import replace

import pytest
import torch
from examples import HEADLINE, WAVELENGTHS, assert_derivative, cooke_triplet, f64, make_lens, view_at

import tasklens
from tasklens.camera.sensor_psfs import trace_sensor_psfs
from tasklens.cli.app import main
from tasklens.design.constraints import first_order_margins
from tasklens.materials.material import model_glass
from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.diffraction import irradiance
from tasklens.optics.analysis.object_points import magnification
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import launch_fields, rim, sobol_disc
from tasklens.optics.analysis.spots import chief_rays, trace_fields, trace_fields_full
from tasklens.optics.analysis.wavefront import path_differences
from tasklens.optics.lens import Lens
from tasklens.optics.tracing.trace import trace
from tasklens.runtime.errors import InputError
from tasklens.settings.specification import Constraints

REFERENCE = WAVELENGTHS[1]
PUPIL = sobol_disc(128, seed=0)
GLASS = model_glass(1.5, 60.0, 0.0)
N = float(make_lens([0.0], [1.0], (GLASS,)).refractive_indices((REFERENCE,))[1, 0])
DOUBLET = HEADLINE / "doublet-imaging2.yaml"


def two_hyperboloids(radius: float, stop: int) -> Lens:
    """Conics -n^2: a point at 30 mm gives parallel rays in the glass, and these a point at 60 mm."""
    semi = [radius if i == stop else torch.inf for i in range(2)]
    curvature, conic = [1 / 30 / (N - 1), -1 / 60 / (N - 1)], [-(N**2)] * 2
    return make_lens(curvature, [8.0, 60.0], (GLASS, "air"), conic=conic, semi_diameter=semi, stop=stop)


def thin_doublet(distance: float) -> Lens:
    """Stop, and thin lenses of 40 mm and -90 mm in contact with it; the image plane is conjugate to the object."""
    c = f64([1 / 40, -1 / 90]) / (N - 1)
    image = 1 / (1 / 40 - 1 / 90 - 1 / distance)
    media, semi = ("air", GLASS, "air", GLASS, "air"), [2.0, *[torch.inf] * 4]
    return make_lens([0, c[0] / 2, -c[0] / 2, c[1] / 2, -c[1] / 2], [0, 0, 0, 0, image], media, semi_diameter=semi)


@pytest.mark.parametrize("stop", [0, 1])
def test_a_perfect_lens_of_a_near_point(stop):
    """NA 0.26 and 0.13: spot below 1e-9 mm, wavefront below 1e-6 waves, Airy's first zero at the working F-number."""
    lens, view = two_hyperboloids(8.0, stop), view_at([[0.0, 0.0]], 30.0)
    rays, opd = trace_fields(lens, view, PUPIL), path_differences(lens, view, PUPIL)
    assert rays.valid.all() and float(rays.l.abs().max()) > 0.1
    assert float(torch.hypot(rays.x, rays.y).max()) < 1e-9
    assert float(opd.abs().max()) < 1e-6
    assert magnification(lens, view) == pytest.approx(-2, rel=1e-12)
    slow = two_hyperboloids(0.5, stop)
    radius = 1e-3 * figures(slow, view, 16)["airy_radius_um"]
    light = irradiance(slow, view, 0, 0, f64([0.0, radius]), f64([0.0]))[0]
    assert float(light[1] / light[0]) < 1e-5


def test_a_thin_doublet_by_hand():
    """1 / s' = 1 / f - 1 / D, m = -s' / D, working F-number m' = s' / (2 R): figures within 1e-9."""
    distance, field = 200.0, 0.1
    lens = thin_doublet(distance)
    image, focal = float(lens.thickness[-1]), 1 / (1 / 40 - 1 / 90)
    view = replace(view_at([[0.0, 0.0], [0.0, field * focal]], distance), efl=focal)
    values = figures(lens, view, 64)
    assert values["object_distance_mm"] == pytest.approx(distance, rel=1e-15)
    assert values["magnification"] == pytest.approx(-image / distance, rel=1e-12)
    assert values["f_number"] == pytest.approx(focal / 4, rel=1e-12)
    assert values["working_f_number"] == pytest.approx(image / 4, rel=1e-12)
    assert values["airy_radius_um"] == pytest.approx(1.21966989 * REFERENCE * image / 4, rel=1e-12)
    assert values["focus_sagittal_um"][0] == pytest.approx(0, abs=1e-9)
    assert values["focus_tangential_um"][0] == pytest.approx(0, abs=1e-9)
    # A chief ray through the middle of thin lenses goes straight to the image of its object point.
    assert values["distortion_percent"][1] == pytest.approx(0, abs=1e-9)
    assert values["angle_deg"][1] == pytest.approx(math.degrees(math.atan(field)), rel=1e-12)
    margins = first_order_margins(lens, Constraints(), view, chief_rays(lens, view))
    assert float(margins["distortion"]) == pytest.approx(Constraints().distortion, abs=1e-9)


def test_rays_come_from_the_object_and_meet_the_stop():
    """A stop inside, three colours: both within 1e-12 mm; from the entrance pupil the object point is at tangent T."""
    lens, view = cooke_triplet(), view_at([[0.0, 0.0], [0.1, 0.2]], 150.0, WAVELENGTHS)
    for pupil in (PUPIL[:16], sobol_disc(512, seed=1)):  # solved ray by ray, and with a polynomial start
        rays = launch_fields(lens, view, pupil)
        assert rays.valid.all() and rays.x.shape == (2, 3, len(pupil))
        back = torch.stack([v - 150 * cosine / rays.n for v, cosine in ((rays.x, rays.l), (rays.y, rays.m))], -1)
        expected = -view.tangents * (150 + paraxial(lens, REFERENCE).entrance_pupil_z)
        torch.testing.assert_close(back, expected[:, None, None].expand_as(back), rtol=0, atol=1e-12)
        stop_rays = trace_fields_full(lens, view, pupil)[1][lens.stop]
        stop_points = torch.stack([stop_rays.x, stop_rays.y], -1)
        torch.testing.assert_close(stop_points, (4.0 * pupil).expand_as(stop_points), rtol=0, atol=1e-12)


def test_a_far_object_is_at_infinity():
    """At 1e9 mm figures equal those at infinity within 1e-6 relative or 1e-4 absolute; wavefronts within 1e-5 waves."""
    lens, view = tasklens.load_lens(DOUBLET)
    far = replace(view, object_vergence=1e-9)
    expected, values = figures(lens, view, 256), figures(lens, far, 256)
    assert {"object_distance_mm", "magnification", "working_f_number"} == values.keys() - expected.keys()
    for key, value in expected.items():
        assert values[key] == pytest.approx(value, rel=1e-6, abs=1e-4, nan_ok=True), key
    opd, at_infinity = (path_differences(lens, variant, PUPIL) for variant in (far, view))
    torch.testing.assert_close(opd, at_infinity, rtol=0, atol=1e-5, equal_nan=True)


@pytest.mark.parametrize("name", ["curvature", "thickness"])
def test_derivatives(name):
    """Of image points and wavefronts, stop inside."""
    lens, view = cooke_triplet(), view_at([[0.0, 0.0], [0.1, -0.2]], 120.0)
    points = torch.cat([0.9 * rim(2), PUPIL[:1]])

    def rays(value: torch.Tensor) -> torch.Tensor:
        changed = replace(lens, **{name: value})
        opened = replace(changed, semi_diameter=torch.full((9,), torch.inf, dtype=torch.float64))
        image = trace(opened, launch_fields(changed, view, points), lens.refractive_indices(view.wavelengths_um))
        return torch.stack([image.x, image.y, path_differences(changed, view, points)])

    step = {"curvature": 1e-6, "thickness": 1e-4}[name]
    for k in range(3):  # x, y and path differ in size
        assert_derivative(lambda value, k=k: rays(value)[k], getattr(lens, name), step, seed=5, rtol=1e-6)


def test_a_sensor_sees_the_image_where_it_is():
    """Thin lenses do not distort: every pixel sees its own position; its field is the position over the scale."""
    distance = 100.0
    lens, focal = thin_doublet(distance), 1 / (1 / 40 - 1 / 90)
    view = replace(view_at([[0.0, 0.0], [0.0, 2.0]], distance), efl=focal, wavelengths_um=(REFERENCE,) * 3)
    psfs = trace_sensor_psfs(lens, view, (40, 60), 40.0, 64, distortion=True)
    rows, columns = ((torch.arange(n) + 0.5) / (n / 2) - 1 for n in (40, 60))
    positions = torch.stack(torch.broadcast_tensors(columns, rows[:, None]), -1)
    torch.testing.assert_close(psfs.source, positions.float(), rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "lens",
    [cooke_triplet(), replace(thin_doublet(150.0), thickness=f64([5.0, 1.0, 2.0, 1.0, 90.0]))],
    ids=["stop inside", "stop in front"],
)
def test_rays_are_those_of_optiland(lens):
    """Image points within 1e-8 mm, for Optiland's object heights."""
    pytest.importorskip("optiland")
    import numpy
    from optiland_lenses import in_optiland

    view = view_at([[0.0, 0.05], [0.1, 0.2]], 150.0)
    optic, _ = in_optiland(lens, view)
    optic.surfaces[0].geometry.cs.z = numpy.array(-150.0)
    heights = -view.tangents * (150 + paraxial(lens, REFERENCE).entrance_pupil_z)
    optic.fields.fields.clear()
    optic.fields.set_type("object_height")
    for x, y in heights.tolist():
        optic.fields.add(x=x, y=y)
    largest = optic.fields.max_field
    rays = trace_fields(lens, view, PUPIL[:32])
    for field, (x, y) in enumerate((heights / largest).tolist()):
        px, py = PUPIL[:32].T.numpy()
        optiland_rays = optic.trace_generic(0 * px + x, 0 * px + y, px, py, REFERENCE)
        torch.testing.assert_close(rays.x[field, 0], torch.as_tensor(optiland_rays.x), rtol=0, atol=1e-8)
        torch.testing.assert_close(rays.y[field, 0], torch.as_tensor(optiland_rays.y), rtol=0, atol=1e-8)


# ---- files, commands, and errors


def test_commands_say_where_the_object_is(tmp_path, capsys):
    def output_of(*arguments) -> str:
        assert main(["lens", *map(str, arguments), "--rays", "64", "--object-distance", "80"]) == 0
        return capsys.readouterr().out

    analysis = json.loads(output_of("analyse", DOUBLET, "--json"))
    assert "object 80 mm in front of the first surface, magnification" in output_of("show", DOUBLET)
    assert f"{analysis['magnification']:.4g}" in output_of("analyse", DOUBLET)
    assert " 80 " in output_of("compare", DOUBLET).splitlines()[1]
    assert json.loads(output_of("show", DOUBLET, "--json"))[str(DOUBLET)]["magnification"] == analysis["magnification"]
    output_of("psf", DOUBLET, "-o", tmp_path / "psf.npz")


def test_an_object_in_the_first_element_is_refused():
    """The object is in front of the vertex, but off the axis inside the glass; a virtual object has no view."""
    lens = make_lens([-1 / 10, -1 / 3], [3.0, 40.0], (GLASS, "air"), semi_diameter=[6.0, 1.0], stop=1)
    assert trace_fields(lens, view_at([[0.0, 0.0]], 1.5), PUPIL).valid.any()
    with pytest.raises(InputError, match=r"the first lens surface reaches 2 mm in front of it"):
        trace_fields(lens, view_at([[0.0, 0.0], [0.0, 4.0]], 1.5), PUPIL)
    with pytest.raises(InputError, match="in front of the lens"):
        view_at([[0.0, 0.0]], -20.0)
