"""Designs that start from a lens of the user: free variables improve it, everything else stays."""

import math
from dataclasses import replace

import pytest
import torch
from examples import assert_close, cooke_file, cooke_triplet, f64, make_lens

import tasklens
from tasklens.cli.app import main
from tasklens.design import from_lens
from tasklens.design.constraints import BUFFER, all_margins, manufacturing_margins, spaces
from tasklens.design.ray_space import RaySpace
from tasklens.design.single import LensRequest, designs
from tasklens.design.variables import free_surfaces
from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.focus import move_image_plane
from tasklens.optics.analysis.spots import OUTLINE, clear_semi_diameters
from tasklens.optics.io import lens_files, zemax
from tasklens.optics.io.lens_files import LensFile
from tasklens.runtime.errors import InputError
from tasklens.settings.specification import Constraints

pytestmark = pytest.mark.usefixtures("few_rays")
STEPS, ONE_STEP = ({"descents": {"0": {"steps": steps}}, "rays": 64} for steps in (40, 1))


def save(folder, **changes) -> LensFile:
    """The Cooke triplet, F/5 with its stop inside, as a Zemax file in `folder`."""
    return lens_files.read(cooke_file(folder / "mine.zmx", **changes), pixel_pitch_um=8.0)


@pytest.fixture(scope="module")
def triplet(tmp_path_factory):
    return save(tmp_path_factory.mktemp("lens"))


def improve(file: LensFile, method: str, free=None, settings=STEPS, constraints=None):
    """The lens, its view, its notes, and remarks."""
    remarks: list[str] = []
    start = file.lens, file.view
    request = LensRequest(method, settings=settings, constraints=constraints, start=start, free=free)
    result = designs(request, remark=remarks.append)
    return result.lens, result.view, result.notes, remarks


def spots(lens, view) -> float:
    return sum(figures(lens, view, 512)["rms_centroid_um"]) / len(view.fields)


def test_a_lens_of_spheres_in_glass_gets_sharper(triplet):
    """Spots shrink by at least a fifth, at the same F-number, with the same glasses, within the lens's own limits."""
    lens, view, notes, remarks = improve(triplet, "spot")
    assert spots(lens, view) < 0.8 * spots(triplet.lens, view)
    assert lens.media == triplet.lens.media and lens.stop == 4 and not lens.alpha.any()
    before, after = (figures(candidate, view, 64) for candidate in (triplet.lens, lens))
    assert after["f_number"] == pytest.approx(before["f_number"], rel=5e-3)
    assert after["efl_mm"] == pytest.approx(before["efl_mm"], rel=0.021)
    assert notes["worst_margin"]["value"] > 0
    assert any("limits that the lens violates are relaxed: " in text for text in remarks)
    changed = abs(after["f_number"] / before["f_number"] - 1) > 1e-2
    said = f"F-number {before['f_number']:.4g} to {after['f_number']:.4g}: the stop is fixed"
    assert any(text.startswith(said) for text in remarks) == changed
    assert float(lens.thickness[6]) != 30.0 and float(lens.thickness[7]) == 1.0  # the cover glass stays


def test_coefficients_of_high_order_that_stay_are_named(triplet):
    """Designs vary coefficients up to r^10; those of surfaces that keep all their coefficients are not named."""
    lens = replace(triplet.lens, alpha=torch.zeros(len(triplet.lens.media), 7, dtype=torch.float64))
    lens.alpha[1, 5], lens.alpha[2, 6] = 1e-20, -1e-22
    *_, remarks = improve(replace(triplet, lens=lens), "spot", {"alpha_4": [1]}, ONE_STEP)
    assert "asphere coefficients of r^12 are fixed" in remarks
    with pytest.raises(InputError, match="alpha_4: surface 99 does not refract"):
        improve(replace(triplet, lens=lens), "spot", {"alpha_4": [99]}, ONE_STEP)


def test_clear_apertures_of_a_lens_stay(tmp_path):
    """The given one clips as before; the others stay automatic.

    A design has red, green and blue, also if the reference of the file is the longest wavelength.
    """
    file = save(tmp_path, primary=0)
    given = replace(file.lens, semi_diameter=file.lens.semi_diameter.index_fill(0, torch.tensor(0), 8.0))
    lens, _, notes, _ = improve(replace(file, lens=given), "spot", settings=ONE_STEP)
    assert list(notes["spec"]["wavelengths_um"]) == [0.6563, 0.5876, 0.4861]
    assert float(lens.semi_diameter[0]) == 8.0
    assert lens.semi_diameter.isfinite().nonzero()[:, 0].tolist() == [0, lens.stop]


def test_only_what_is_free_changes(triplet):
    free, few = {"curvature": [0, 6], "thickness": [8]}, {"descents": {"0": {"steps": 5}}, "rays": 64}
    lens, *_ = improve(triplet, "spot", free, few, constraints={"max_slope": 2.0})
    moved = (lens.curvature != triplet.lens.curvature).nonzero()[:, 0].tolist()
    assert moved == [0, 6] and (lens.thickness != triplet.lens.thickness).nonzero()[:, 0].tolist() == [8]
    assert spots(lens, triplet.view) < spots(triplet.lens, triplet.view)


def test_variables_that_are_free_by_default():
    """Curvatures and distances, except of plane plates; aspheric coefficients only of aspheres or on request."""
    lens = cooke_triplet()
    bent, moving = (0, 1, 2, 3, 5, 6), (0, 1, 2, 3, 5, 6, 8)
    assert free_surfaces(lens, None) == {
        "curvature": bent, "thickness": moving, "alpha_4": (), "alpha_6": (), "alpha_8": (), "alpha_10": (),
    }  # fmt: skip
    assert free_surfaces(lens, {"alpha_4": None}) == {"alpha_4": bent}
    alpha = torch.zeros(9, 2, dtype=torch.float64)
    alpha[6, 1] = 1e-6
    assert free_surfaces(replace(lens, alpha=alpha), None)["alpha_6"] == (6,)
    for free, words in (({"radius": [0]}, "unknown variable 'radius'"), ({"alpha_4": []}, "at least one variable")):
        with pytest.raises(InputError, match=words):
            free_surfaces(lens, free)


def test_limits_give_way_to_the_lens(triplet):
    """Limits of a phone lens, scaled to 50 mm; a violated one gives way to the lens's own value, a given one stays."""
    limits, remark = from_lens.own_limits(triplet.lens, triplet.view, Constraints(), set())
    clear = clear_semi_diameters(triplet.lens, triplet.view, OUTLINE)
    margins = all_margins(triplet.lens, limits, triplet.view, clear)
    assert min(float(margin.min()) for margin in margins.values()) > 0
    assert limits.max_track == pytest.approx(4.4 * triplet.view.efl / 2.921, rel=1e-3)
    assert limits.min_centre_thickness == pytest.approx(0.99997 - BUFFER, abs=1e-9) and "min_centre" in remark
    thick = Constraints(min_centre_thickness=2.0)
    kept, _ = from_lens.own_limits(triplet.lens, triplet.view, thick, {"min_centre_thickness"})
    assert kept.min_centre_thickness == 2.0


def test_surfaces_may_touch_but_not_cross(triplet):
    """Here the cover glass and the sensor."""

    def limits(distance: float) -> Constraints:
        lens = move_image_plane(triplet.lens, distance - triplet.lens.thickness[-1])
        return from_lens.own_limits(lens, triplet.view, Constraints(), set())[0]

    for distance in (0.0, 0.005):
        assert limits(distance).min_back_focus == pytest.approx(distance - BUFFER, abs=1e-9)
    with pytest.raises(InputError, match=r"min_back_focus: -0\.2 mm within the light, so surfaces cross"):
        limits(-0.2)


def test_a_start_with_too_wide_a_field_or_without_light_is_refused_before_the_work(triplet):
    fields = triplet.view.fields * (math.tan(math.radians(80)) * triplet.view.efl / triplet.view.radii.max())
    with pytest.raises(InputError, match="a field of view of 160 degrees: designs need less than 150"):
        improve(replace(triplet, view=replace(triplet.view, fields=fields)), "spot")
    semi = triplet.lens.semi_diameter.index_fill(0, torch.tensor(0), 1e-3)
    with pytest.raises(InputError, match=r"no light arrives at \d of 9 fields; correct the lens"):
        improve(replace(triplet, lens=replace(triplet.lens, semi_diameter=semi)), "spot")


def test_a_stop_between_elements_bounds_no_space():
    """The air between the second and the third element is one space; only a stop in front has a space."""
    lens = cooke_triplet()
    front, behind, element = spaces(lens)
    pairs = list(zip(front.tolist(), behind.tolist(), strict=True))
    assert pairs == [(0, 1), (1, 2), (2, 3), (3, 5), (5, 6), (6, 7), (7, 8)]
    assert element.tolist() == [True, False, True, False, True, False, True]
    limits = Constraints(min_air_gap=0.05)
    gap = manufacturing_margins(lens, limits, f64([6.0] * 9))["min_air_gap"].reshape(3, -1)[1] + 0.05
    assert float(gap[0]) == pytest.approx(0.5 + 4.25041, rel=1e-12)


def test_a_plane_in_air_behind_the_lens_bounds_nothing():
    """The back focus is that of the last surface that refracts, wherever a plane for the defocus lies."""
    lens = make_lens([0.1, -0.1], [1.0, 3.0], ("COC", "air"), semi_diameter=[1.0, 1.0])
    planes = make_lens([0.1, -0.1, 0.0], [1.0, 3.5, -0.5], ("COC", "air", "air"), semi_diameter=[1.0] * 3)
    actual, expected = (manufacturing_margins(each, Constraints(), each.semi_diameter) for each in (planes, lens))
    assert_close(actual["min_back_focus"], expected["min_back_focus"], 1e-15)


def test_a_sensor_keeps_its_shape(triplet):
    fields = 0.6 * triplet.view.fields * f64([1.0, 4 / 3])  # from 16:9
    _, view, _, _ = improve(replace(triplet, view=replace(triplet.view, fields=fields)), "spot", settings=ONE_STEP)
    assert float(view.fields[:, 0].max() / view.fields[:, 1].max()) == pytest.approx(4 / 3)


def test_the_linear_model_of_a_lens_with_its_stop_inside(triplet):
    """The model ignores changes of ray aiming; changes of ray errors are right within a tenth."""
    limits, _ = from_lens.own_limits(triplet.lens, triplet.view, Constraints(), set())
    alpha = torch.zeros(9, 5, dtype=torch.float64)
    space = RaySpace(replace(triplet.lens, alpha=alpha), triplet.view, limits, {"curvature": (5,), "thickness": (6,)})
    assert space.start.shape == (2,)
    residuals, columns = space.merit.linearise(space.lens(space.start))
    predicted = columns(space.directions)[: space.merit.rays]
    for k, step in enumerate((1e-6, 1e-4)):
        change = torch.zeros(2, dtype=torch.float64)
        change[k] = step
        moved = space.merit.residuals(space.lens(space.start + change)) - residuals
        error = predicted[:, k] - moved[: space.merit.rays] / step
        assert float(error.norm() / predicted[:, k].norm()) < 0.1


SHORT = ("--set", "descents.0.steps=4", "--set", "rays=64")
COMMAND = ("design", "--start", "mine.zmx", "--pixel-pitch", "8", *SHORT, "-o", "better.zmx")


def test_the_command(here, capsys):
    """From a Zemax file to a Zemax file, by contrast; the result is readable, also by Optiland."""
    file = save(here)
    assert main([*COMMAND, "--method", "contrast", "--free", "curvature,thickness:1+3+8"]) == 0
    assert "design: contrast by descents, seed 0" in capsys.readouterr().out
    lens = zemax.read(here / "better.zmx").lens
    assert lens.media[0].abbe() == file.lens.media[0].abbe() and float(lens.thickness[0]) == 3.25896
    assert (lens.curvature != file.lens.curvature)[[0, 1, 2, 3, 5, 6]].all()
    fileio = pytest.importorskip("optiland.fileio")
    optic = fileio.load_zemax_file(str(here / "better.zmx"))
    expected = figures(lens, file.view, 64)["efl_mm"]
    assert float(optic.paraxial.f2()) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("--elements", "COC"), "--elements, --diagonal: not allowed with --start"),
        (("--free", "radius"), "free: unknown variable 'radius'; expected some of curvature, thickness, alpha_4"),
        (("--free", "curvature:4"), "free: curvature: surface 4 does not refract; expected some of 0, 1, 2, 3, 5"),
        (("--free", "alpha_x"), "--free alpha_x: expected variables such as curvature,thickness:1+3,alpha_4..10"),
        (("--method", "least_squares"), "method: least_squares starts from random lenses"),
        (("--wavelengths", "0.55"), "designs need three wavelengths: --wavelengths 0.65,0.55,0.47"),
        (("--field-of-view", "0.05"), "field_of_view_deg"),
        (("--object-distance", "400"), "designs need an object at infinity: give --object-distance inf"),
        (("--limit", "flat_track=3"), "--limit flat_track: only for designs from flat plates"),
        (("--output", "my lens.zmx"), "my lens.zmx: its glass catalogue would have the same name"),
        (("--output", "mine_too.zmx"), "mine_too.agf: already exists; --force overwrites it"),
    ],
)
def test_impossible_options_are_refused(here, capsys, arguments, words):
    save(here)
    (here / "mine_too.agf").touch()
    method = () if "--method" in arguments else ("--method", "spot")
    assert main([*COMMAND, *method, *arguments]) == 2
    assert words in capsys.readouterr().err and not (here / "better.zmx").exists()


def test_what_was_assumed_is_a_warning_in_python(tmp_path):
    """As in `load_lens`; nothing is printed to the program's standard error."""
    save(tmp_path)
    with pytest.warns(UserWarning, match="limits that the lens violates are relaxed"):
        tasklens.design_lens("spot", start=tmp_path / "mine.zmx", settings=ONE_STEP)
