"""Lenses from files as they are used: wavelengths, fields and objects from the file, and assumptions."""

import math
from dataclasses import replace

import numpy
import pytest
import torch
import yaml
from examples import HEADLINE, cooke_file, cooke_triplet, f64, make_lens

import tasklens
from tasklens.optics.analysis.focus import refocus
from tasklens.optics.analysis.spots import chief_rays
from tasklens.optics.io import lens_files, prescription
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.io.spec_section import spec_of
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError

HEIGHTS = ((0.0, 0.0), (0.0, 18.2))
BICONVEX = [{"radius": 50.0, "thickness": 5.0, "material": "N-BK7", "stop": True}, {"radius": -50.0}]


def save(tmp_path, **changes) -> lens_files.LensFile:
    """The Cooke triplet as a Zemax file with other data, as it is used."""
    changes = {"wavelengths_um": (0.4861, 0.5876, 0.6563)} | changes
    return lens_files.read(cooke_file(tmp_path / "lens.zmx", **changes))


def with_aperture(surface: int, radius_mm: float) -> Lens:
    """The Cooke triplet with another semi-diameter of a surface."""
    semi_diameter = cooke_triplet().semi_diameter.clone()
    semi_diameter[surface] = radius_mm
    return cooke_triplet(semi_diameter=semi_diameter)


@pytest.mark.parametrize(
    "wavelengths, primary, expected",
    [
        ((0.4861, 0.5876, 0.6563), 1, (0.6563, 0.5876, 0.4861)),
        ((0.5, 0.6), 1, (0.5, 0.6)),
        ((0.7, 0.65, 0.6, 0.55), 3, (0.7, 0.65, 0.55, 0.6)),
    ],
)
def test_wavelengths_are_those_of_the_file(tmp_path, wavelengths, primary, expected):
    """Any number, the primary one in the middle, where the reference is; no remark about them."""
    file = save(tmp_path, wavelengths_um=wavelengths, primary=primary)
    assert file.view.wavelengths_um == expected and file.view.reference_um == wavelengths[primary]
    assert not any("wavelength" in remark for remark in file.remarks)
    other = lens_files.read(tmp_path / "lens.zmx", wavelengths_um=["0.52"])
    assert other.view.wavelengths_um == (0.52,)
    with pytest.warns(UserWarning, match=r"lens\.zmx: no pixels in the file"):
        tasklens.load_lens(tmp_path / "lens.zmx")


def test_any_number_of_wavelengths_is_drawn_and_simulated(tmp_path):
    """One colour: red, green and blue are blurred alike; of four, the longest, a middle one and the shortest count."""
    image = torch.rand(3, 60, 60, generator=torch.Generator().manual_seed(1))
    one = save(tmp_path, wavelengths_um=(0.55,), primary=0)
    grey = image.mean(0).expand(3, -1, -1)
    capture = tasklens.simulate(one.lens, one.view, grey, fields=[(0, 3.0)], rays=256)
    assert capture.shape == (1, 3, 60, 60) and torch.allclose(capture[0, 0], capture[0, 2], atol=1e-6)
    four = save(tmp_path, wavelengths_um=(0.7, 0.65, 0.6, 0.55), primary=3)
    three = replace(four.view, wavelengths_um=(0.7, 0.6, 0.55))
    captures = [tasklens.simulate(four.lens, view, image, fields=[(0, 3.0)], rays=256) for view in (four.view, three)]
    assert torch.equal(*captures)


def test_a_real_image_height_is_solved_without_clear_apertures(tmp_path):
    """The chief ray of the field meets the image at the height, whatever clips it; a dark field is a remark."""
    open_file = save(tmp_path, fields=("real_image_height_mm", HEIGHTS))
    angle = float(torch.rad2deg(torch.atan(open_file.view.tangents.norm(dim=-1).max())))
    field = f64([[0.0, math.tan(math.radians(angle)) * open_file.view.efl]])
    chief = chief_rays(open_file.lens, replace(open_file.view.in_reference(), fields=field))
    assert abs(float(chief.y)) == pytest.approx(18.2, abs=1e-6)
    clipped = save(tmp_path, lens=with_aperture(6, 1.0), fields=("real_image_height_mm", HEIGHTS))
    torch.testing.assert_close(clipped.view.tangents, open_file.view.tangents, rtol=1e-9, atol=0)
    assert any(" does not arrive at " in remark or "no light" in remark for remark in clipped.remarks)


def test_where_light_is_lost_is_a_remark(tmp_path):
    """Rays that miss a surface, and marginal rays that a rear element clips."""
    save(tmp_path)
    wide = lens_files.read(tmp_path / "lens.zmx", field_of_view_deg=90.0)
    (remark,) = (text for text in wide.remarks if "no light arrives at" in text)
    assert "lost by total internal reflection at surface 3" in remark
    (*_, remark) = save(tmp_path, lens=with_aperture(6, 4.0)).remarks
    assert "marginal rays on the axis are lost at the clear aperture of surface 6 (the first is 0)" in remark


def test_what_no_lens_can_have_is_refused(tmp_path):
    with pytest.raises(FileError, match="a field of 95 degrees: expected less than 90"):
        save(tmp_path, fields=("angle_deg", ((0.0, 95.0),)))
    with pytest.raises(FileError, match=r"F/0.3\d: faster than F/0.5"):
        save(tmp_path, lens=with_aperture(cooke_triplet().stop, 60.0))
    with pytest.raises(InputError, match=r"f_number = 0\.4: expected greater than or equal to 0\.5"):
        tasklens.lens(BICONVEX, field_of_view_deg=4, f_number=0.4)


def test_an_aperture_that_does_not_fit_the_stop_is_refused(tmp_path):
    """An F-number edited by hand; the radius of the stop has to change with it."""
    path = tmp_path / "lens.yaml"
    tasklens.save_lens(path, *tasklens.lens(BICONVEX, 10, 4.0))
    content = yaml.safe_load(path.read_text())
    content |= {"aperture": {"f_number": 4.0}, "wavelengths_um": content["spec"]["wavelengths_um"], "primary": 1}
    path.write_text(yaml.safe_dump(content))
    lens_files.read(path)
    path.write_text(yaml.safe_dump(content | {"aperture": {"f_number": 2.0}}))
    with pytest.raises(FileError, match=r"aperture: f_number = 2 needs a stop of \S+ mm, but its semi_diameter is \S+"):
        lens_files.read(path)


def test_a_slow_relay_with_a_large_pupil_is_read(tmp_path):
    """Almost telecentric: its beam is slow, although the entrance pupil is larger than the focal length."""
    lens = make_lens([0.02, -0.02, 0.0], [4.0, 47.0, 55.0], ("COC", "air", "air"), stop=2)
    lens.semi_diameter[2] = 6.0
    near = {"object_distance_mm": 94.0, "fields": ("object_height_mm", ((0.0, 0.0), (0.0, 1.0)))}
    view = save(tmp_path, lens=lens, **near).view
    assert view.object_vergence == pytest.approx(1 / 94)


def test_a_lens_whose_only_field_is_the_axis(tmp_path):
    """Stock lenses have such files: they are used on the axis, which is a remark."""
    file = save(tmp_path, fields=("angle_deg", ((0.0, 0.0),)))
    assert file.view.fields.tolist() == [[0.0, 0.0]] and "no field except the axis" in file.remarks[0]
    wide = lens_files.read(tmp_path / "lens.zmx", field_of_view_deg=40.0)
    on_axis, of_wide = (tasklens.analyse(f.lens, f.view, rays=64)["rms_centroid_um"][0] for f in (file, wide))
    assert on_axis == pytest.approx(of_wide, rel=1e-12)


def test_paraxial_image_heights_of_a_near_object(tmp_path):
    """The field whose paraxial image has the height: object height over magnification."""
    near = {"object_distance_mm": 500.0, "fields": ("paraxial_image_height_mm", ((0.0, 10.0),))}
    image = save(tmp_path, **near)
    scale = tasklens.analyse(image.lens, image.view, rays=64)["magnification"]
    near["fields"] = ("object_height_mm", ((0.0, 10.0 / abs(scale)),))
    torch.testing.assert_close(save(tmp_path, **near).view.tangents, image.view.tangents, rtol=1e-9, atol=0)


@pytest.mark.parametrize("name", ["lens.yaml", "lens.zmx"])
def test_a_lens_for_a_near_object_is_refocused_for_a_far_one(tmp_path, name):
    """Its image goes back by f^2 / (s - f), about 10 mm."""
    view = View(f64([[0.0, 0.0], [0.0, 2.0]]), 50.0, (0.6563, 0.5876, 0.4861), 5.0, 51, 1 / 300)
    near = refocus(cooke_triplet(), view)
    lens_data = prescription.with_system_data(Prescription(near, object_distance_mm=300.0), view)
    content = {"spec": spec_of(view), "figures": tasklens.analyse(near, view, rays=64)}
    lens_files.write(tmp_path / name, lens_data, content)
    file = lens_files.read(tmp_path / name)
    assert torch.equal(file.lens.thickness, near.thickness) and not any("object" in remark for remark in file.remarks)
    assert file.prescription.object_distance_mm == pytest.approx(300, rel=1e-12) == 1 / file.view.object_vergence
    with pytest.warns(UserWarning, match="object at 300 mm in the file: refocused for infinity"):
        far, _ = tasklens.load_lens(tmp_path / name, object_distance_mm=numpy.float32(math.inf))
    infinity = refocus(cooke_triplet(), replace(view, object_vergence=0.0))
    assert float(far.thickness[-1]) == pytest.approx(float(infinity.thickness[-1]), abs=0.02)
    assert float(near.thickness[-1] - far.thickness[-1]) == pytest.approx(10, abs=1)


@pytest.mark.parametrize("between", [(), (0.52, 0.61)])
def test_wavelengths_of_the_source_are_no_contradiction(tmp_path, between):
    """A lens that was improved from a Zemax file keeps the order of the file, from blue to red, and all of them."""
    source = lens_files.read(HEADLINE / "doublet-imaging2.yaml")
    red, green, blue = source.view.wavelengths_um
    turned = replace(source.prescription, wavelengths_um=(blue, green, *between, red), primary=1)
    lens_files.write(tmp_path / "lens.yaml", turned, source.content)
    file = lens_files.read(tmp_path / "lens.yaml")
    assert file.prescription.wavelengths_um == turned.wavelengths_um
    assert file.view.wavelengths_um == source.view.wavelengths_um


def test_a_missing_catalogue_is_an_error_for_every_lens(tmp_path):
    """Also for a lens.yaml, which needs none."""
    with pytest.raises(FileError, match=r"mine\.agf: no such file"):
        lens_files.read(HEADLINE / "doublet-imaging2.yaml", [tmp_path / "mine.agf"])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"obect_distance_mm": 500}, "obect_distance_mm: unknown key; did you mean object_distance_mm?"),
        ({"wavelengths_um": [0.9, 0.8, 0.7], "primary": 1}, "wavelengths_um and primary contradict"),
        ({"wavelengths_um": [0.6563, 0.5893, 0.4861], "primary": 0}, "whose middle one is the reference"),
        ({"spec.pixel_pich_um": 3}, "spec.pixel_pich_um: unknown key; did you mean pixel_pitch_um?"),
        ({"spec.object_distance_mm": 500}, "500 contradicts object_distance_mm, from which it is inf"),
        ({"spec.field_of_view_deg": 40}, "40 contradicts fields_mm and efl_mm, from which it is 68.8"),
        ({"spec.f_number": 5.6}, "spec.f_number = 5.6 contradicts stop_radius_mm, from which it is 2.8"),
        ({"spec.diagonal_mm": 8}, "spec.diagonal_mm = 8 contradicts fields_mm, from which it is 4;"),
        ({"format": 1}, "format 1, expected 2; export the lens with the version of"),
    ],
)
def test_an_edited_file_that_contradicts_itself_is_refused(tmp_path, changes, words):
    """Copies of the specification, and misspelled keys, would otherwise have no effect; other keys are notes."""
    content = yaml.safe_load((HEADLINE / "doublet-imaging2.yaml").read_text()) | {"purpose": "a note"}
    path = tmp_path / "lens.yaml"
    path.write_text(yaml.safe_dump(content))
    assert lens_files.read(path).content["purpose"] == "a note"
    for key, value in changes.items():
        section, _, inner = key.partition(".")
        content[section] = content[section] | {inner: value} if inner else value
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(FileError, match=words):
        lens_files.read(path)
