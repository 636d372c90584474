"""Figures in a lens file and their table: every number agrees with traced rays; manufacturability."""

import math
from dataclasses import replace

import pytest
import torch
from examples import cooke_triplet, f64, lens_and_view, make_lens, materials

from tasklens.optics.analysis.aberrations import field_curvature, seidel_sums
from tasklens.optics.analysis.datasheet import figures, seidel_by_surface
from tasklens.optics.analysis.mtf import geometric_mtf
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, chief_points, evaluation_psf, rms_spot_radius, trace_fields
from tasklens.optics.analysis.wavefront import path_differences, rms_wavefront_error
from tasklens.optics.io import prescription
from tasklens.optics.io.spec_section import spec_of, view_of
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.show import certificate
from tasklens.study.jobs.psf_tail import tail

RAYS = 512


@pytest.fixture(scope="module")
def lens():
    return lens_and_view()


@pytest.fixture(scope="module")
def lens_figures(lens):
    return figures(*lens, RAYS)


def test_figures_agree_with_the_psf_and_the_rays(lens, lens_figures):
    """Valid fraction, energy in the window, RMS, MTF, distortion and foci, field by field."""
    lens, view = lens
    rays = trace_fields(lens, view, sobol_disc(RAYS, 0))
    grid = evaluation_psf(lens, view, RAYS)
    # A ray within the outermost half pixel counts as inside, while the PSF shares it with the pixel beyond.
    assert (f64(lens_figures["energy_in_window"]) - grid.sum((-2, -1)).mean(1)).abs().max() < 0.02
    assert lens_figures["valid_fraction"] == [1.0] * 3
    torch.testing.assert_close(f64(lens_figures["rms_centroid_um"]), 1e3 * rms_spot_radius(rays, centroid(rays)))
    near_axis = chief_points(lens, replace(view, fields=1e-3 * view.fields))[1:].norm(dim=-1)
    real = chief_points(lens, view)[1:].norm(dim=-1) / (1e3 * near_axis) - 1
    torch.testing.assert_close(f64(lens_figures["distortion_percent"][1:]), 100 * real, rtol=1e-4, atol=1e-6)
    assert lens_figures["distortion_percent"][0] == 0
    nyquist = 1 / (2 * 9e-3)
    mtf = geometric_mtf(rays, view.directions, [nyquist / 4, nyquist / 2])
    names = [[f"mtf_{d}_{f}_nyquist" for f in ("quarter", "half")] for d in ("tangential", "sagittal")]
    torch.testing.assert_close(f64([[lens_figures[name] for name in row] for row in names]), torch.stack(mtf).mT)
    opd = path_differences(lens, view.in_reference(), sobol_disc(RAYS, 0))[:, 0]
    torch.testing.assert_close(f64(lens_figures["rms_wavefront_waves"]), rms_wavefront_error(opd, sobol_disc(RAYS, 0)))
    foci = torch.stack(field_curvature(lens, view))
    actual = f64([lens_figures["focus_tangential_um"], lens_figures["focus_sagittal_um"]])
    torch.testing.assert_close(actual, 1e3 * foci)
    assert all(a <= b for a, b in zip(lens_figures["rms_centroid_um"], lens_figures["rms_chief_ray_um"], strict=True))
    assert all(a <= b for a, b in zip(lens_figures["core_radius_um"], lens_figures["radius_80_um"], strict=True))


def test_figures_of_the_whole_lens(lens, lens_figures):
    lens, view = lens
    assert lens_figures["track_mm"] == pytest.approx(float(lens.thickness.sum()))
    assert lens_figures["entrance_pupil_diameter_mm"] == pytest.approx(0.6)
    first_order = paraxial(lens, view.reference_um)
    assert lens_figures["exit_pupil_z_mm"] == float(first_order.exit_pupil_z)
    assert lens_figures["exit_pupil_diameter_mm"] == 2 * float(first_order.exit_pupil_radius)
    assert lens_figures["f_number"] == pytest.approx(lens_figures["efl_mm"] / 0.6)
    cutoff = lens_figures["diffraction_cutoff_per_mm"]
    assert cutoff == pytest.approx(1e3 / (view.reference_um * abs(lens_figures["f_number"])))
    assert lens_figures["airy_radius_um"] == pytest.approx(1.22e3 / cutoff, rel=1e-3)
    sums = {name: 1e3 * float(values.sum()) for name, values in seidel_sums(lens, view).items()}
    assert lens_figures["seidel_um"] == pytest.approx(sums, rel=1e-12)


def test_the_track_begins_at_the_first_surface():
    """If the stop is inside, elements in front of it are part of the track."""
    lens = make_lens([0.3, 0.0, -0.3], [0.5, 0.7, 3.0], ("COC", "air", "COC"), semi_diameter=[9, 0.3, 9], stop=1)
    view = View(f64([[0.0, 0.1]]), 3.0, (0.5893,), 1.8, 3)
    assert figures(lens, view, 16)["track_mm"] == pytest.approx(4.2)


@pytest.mark.parametrize("shift", [0.0, -2.0])
def test_distortion_grows_as_the_square_of_the_field(shift):
    """By third-order theory, from zero at the axis, also off the paraxial focus and at another focal length."""
    lens = cooke_triplet()
    thickness = lens.thickness.clone()
    thickness[-1] += shift
    fields = f64([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]])
    for efl in (50.0, 51.0):
        view = View(fields, efl, (0.5876,), 8.0, 31)
        axis, one, two = figures(replace(lens, thickness=thickness), view, 16)["distortion_percent"]
        assert axis == 0 and abs(two) < 0.1 and two / one == pytest.approx(4, rel=0.05)


def test_a_lost_field_has_no_good_figure():
    """Zero light and contrast, an infinite spot, and NaN for figures of the lost chief ray."""
    lens = make_lens([0.0, 0.3], [1.0, 5.0], ("air", "COC"), semi_diameter=[0.1, 0.5])
    values = figures(lens, View(f64([[0.0, 0.0], [0.0, 2.0]]), 2.0, (0.5893,), 1.8, 31), 64)
    assert math.isfinite(values["rms_centroid_um"][0]) and values["rms_centroid_um"][1] == math.inf
    about_chief = ("rms_chief_ray_um", "core_radius_um", "radius_80_um", "rms_wavefront_waves", "distortion_percent")
    for name in (*about_chief, "focus_tangential_um", "focus_sagittal_um"):
        assert math.isfinite(values[name][0]) and math.isnan(values[name][1]), name
    mtf = [name for name in values if name.startswith("mtf_")]
    for name in ("valid_fraction", "energy_in_window", "relative_illumination", *mtf):
        assert values[name][0] > 0 and values[name][1] == 0, name


def test_the_light_in_the_window_of_a_field_whose_chief_ray_an_aperture_stops():
    """As in its PSF and its tail, whose windows are about the chief ray through open apertures."""
    lens = cooke_triplet(semi_diameter=f64([4.0, *[math.inf] * 3, 4.0, *[math.inf] * 4]))
    view = View(f64([[0.0, 0.0], [0.0, 18.0]]), 50.0, (0.5876,), 10.0, 101)
    values, (axis, corner) = figures(lens, view, 256), tail(lens, view, 256)[0]
    assert values["energy_in_window"] == pytest.approx([1 - row["energy_outside_window"] for row in (axis, corner)])
    assert math.isnan(values["rms_chief_ray_um"][1]) and 0 < values["valid_fraction"][1] < 0.5
    assert values["energy_in_window"][1] > 0.9


def test_the_spec_of_a_file_is_the_view_that_made_its_figures(lens, lens_figures, tmp_path):
    """Written with its spec and read again: the same figures to the last bit."""
    lens, view = lens
    path, content = tmp_path / "lens.yaml", {"spec": spec_of(view), "figures": lens_figures}
    prescription.write(path, prescription.Prescription(lens), content)
    reread, content = prescription.read(path)
    assert figures(reread.lens, view_of(reread.lens, content, "lens.yaml"), RAYS) == content["figures"] == lens_figures
    with pytest.raises(FileError, match=r"^lens\.yaml: has no spec"):
        view_of(reread.lens, {}, "lens.yaml")


@pytest.mark.parametrize("radius", [0.0, -0.3, math.nan, math.inf])
def test_a_lens_whose_stop_is_no_disc_has_no_figures(lens, radius):
    """Refused with surface and radius, and for a file with its name: through a point every lens would be perfect."""
    lens, view = lens
    semi_diameter = lens.semi_diameter.clone()
    semi_diameter[lens.stop] = radius
    lens = replace(lens, semi_diameter=semi_diameter)
    words = f"surface 0: semi_diameter: the radius of the stop is {radius} mm"
    with pytest.raises(InputError, match=words):
        figures(lens, view, 16)
    with pytest.raises(FileError, match=f"^lens.yaml: {words}"):
        view_of(lens, {"spec": spec_of(view)}, "lens.yaml")


def test_certificate_shows_the_numbers_of_the_file(lens, lens_figures):
    """A column per field and a row per surface with their figures, the totals last, the worst margin if it is known."""
    lens, view = lens
    by_surface = seidel_by_surface(lens, view)
    content = {"figures": lens_figures, "worst_margin": {"limit": "max_slope", "value": -0.0123}}
    content["origin"] = {"validation_loss": 0.25, "candidate_losses": {"imaging2": 0.5}}
    text = certificate.markdown("a lens", view.fields.tolist(), content, by_surface)
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    pairs = dict(line for line in lines if len(line) == 2)
    assert float(pairs["focal length [mm]"]) == pytest.approx(lens_figures["efl_mm"], abs=1e-4)
    assert pairs["worst margin"] == "-0.0123 (max_slope)"
    assert pairs["loss of this lens on the fixed images of its design"] == "0.2500"
    assert pairs["loss of imaging2 as a candidate start"] == "0.5000"
    by_field = {name: list(map(float, values)) for name, *values in lines if len(values) == 3 and name.strip("-:")}
    assert by_field["field"] == [1, 2, 3]
    assert by_field["EE80 [um]"] == pytest.approx(lens_figures["radius_80_um"], abs=5e-3)
    assert by_field["RMS wavefront [waves]"] == pytest.approx(lens_figures["rms_wavefront_waves"], abs=5e-4)
    assert by_field["MTF S 1/2"] == pytest.approx(lens_figures["mtf_sagittal_half_nyquist"], abs=5.1e-3)
    header, _, *surfaces = [line for line in lines if len(line) == 8]
    assert header == ["surface", "S_I", "S_II", "S_III", "S_IV", "S_V", "C_I", "C_II"]
    assert [row[0] for row in surfaces] == ["0", "1", "2", "3", "4", "sum"]
    columns = f64([[float(v) for v in row[1:]] for row in surfaces])
    torch.testing.assert_close(columns[:-1].sum(0), columns[-1], rtol=0, atol=4e-3)
    assert "worst margin" not in certificate.markdown("", view.fields.tolist(), {"figures": lens_figures}, by_surface)


COC, AIR = materials("COC", "air")


def asphere(curvature: float, alpha_4: float, semi_diameter: float = 1.0):
    """One element behind a stop; its front is the asphere, its back plane."""
    alpha = f64([[0.0, 0.0], [0.0, alpha_4], [0.0, 0.0]])
    apertures = [0.5, semi_diameter, semi_diameter]
    return make_lens([0.0, curvature, 0.0], [0.1, 0.5, 3.0], (AIR, COC, AIR), alpha=alpha, semi_diameter=apertures)


def test_shape_of_a_sphere():
    """sin(steepest) = c R; no departure from itself, no inflection; a plane has nothing."""
    sphere, plane = certificate.shapes(asphere(0.4, 0.0)).itertuples()
    assert (sphere.surface, plane.surface) == (1, 2) and sphere.semi_diameter_mm == 1.0
    assert sphere.steepest_deg == pytest.approx(math.degrees(math.asin(0.4)), abs=1e-9)
    assert sphere.departure_um == pytest.approx(0.0, abs=1e-9) and sphere.inflections == 0
    assert plane.steepest_deg == plane.departure_um == plane.inflections == 0


def test_shape_of_an_asphere():
    """z = c r^2 / 2 + a r^4 with small c bends back where c + 12 a r^2 = 0; the departure is largest half-way in r^2.

    Against the parabola through the rim: a (r^4 - R^2 r^2), at most a R^4 / 4; sphere and parabola differ by c^3.
    """
    shape = certificate.shapes(asphere(0.012, -0.004)).iloc[0]
    assert shape.inflections == 1
    assert shape.departure_um == pytest.approx(1e3 * 0.004 / 4, abs=2e-3)
    assert shape.steepest_deg == pytest.approx(math.degrees(math.atan(0.016 - 0.012)), abs=2e-4)
    assert certificate.shapes(asphere(0.012, 0.004)).inflections[0] == 0


def test_page_says_whether_it_can_be_made():
    """Limits first; then whether errors move the core by less than a pixel: 0.5 um at the tolerance, 0.2 on average."""
    margins, violated = {"max_slope": 0.01, "min_air_gap": 0.02}, {"max_slope": -0.03, "min_air_gap": 0.02}
    calm, lively = {"radius 1": 0.3, "thickness 1": 0.4}, {"radius 1": 3.0, "thickness 1": 4.0}
    surfaces = certificate.shapes(asphere(0.4, 0.0))
    page = certificate.manufacturability(margins, surfaces, calm, "precision_moulding", 1.8)
    assert page.startswith("## Manufacturability\n") and "Within precision moulding. All limits are kept" in page
    assert "move them by 0.2 um (RMS over many lenses" in page and "thickness 1 (0.4 um)" in page
    assert "23.6" in page
    page = certificate.manufacturability(margins, surfaces, lively, "precision_moulding", 1.8)
    assert "Needs tighter tolerances" in page
    page = certificate.manufacturability(violated, surfaces, calm, "precision_moulding", 1.8)
    assert "Not manufacturable: it violates max slope by 0.03." in page


@pytest.mark.parametrize(
    "margin, moved_um, words",
    [(0.0, 1.8, "Within"), (0.0, 1.81, "Needs tighter"), (0.0, 20.0, "20.0 um RMS"), (math.nan, 0.0, "Not manufact")],
)
def test_a_lens_is_robust_up_to_a_pixel(margin, moved_um, words):
    """A margin that is no number is violated."""
    assert words in certificate.limits_verdict({"max_slope": margin}, moved_um, "precision moulding", 1.8)
