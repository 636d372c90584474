"""The public functions have readable help, and return what it says in shapes, units and gradients."""

import importlib.metadata
import inspect
import math
from dataclasses import replace

import numpy
import pytest
import torch
from examples import HEADLINE
from PIL import Image
from typed_lenses import COOKE

import tasklens
from tasklens.design.single import Specification
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.lens import Melt
from tasklens.runtime.errors import InputError
from tasklens.settings.specification import Spec


@pytest.fixture(scope="module")
def doublet():
    return tasklens.load_lens(HEADLINE / "doublet-imaging2.yaml")


TYPES = {"InputError", "Lens", "Ranking", "SensorSettings", "View"}


@pytest.mark.parametrize("name", sorted({*tasklens.__all__} - TYPES))
def test_help_can_be_read(name):
    """Help has a sentence, every argument and an example; a wrong name is an AttributeError."""
    member = getattr(tasklens, name)
    assert name in dir(tasklens)
    text = inspect.getdoc(member)
    assert text.split("\n")[0].endswith((".", ";")) and f"tasklens.{name}(" in text
    for argument in inspect.signature(member).parameters:
        if argument not in ("lens", "view", "arguments", "keywords"):
            assert argument in text, argument
    with pytest.raises(AttributeError, match="tracee"):
        tasklens.tracee  # noqa: B018


def test_a_lens_and_its_view(doublet, tmp_path):
    """Nine fields up to the corner of the sensor [mm], three wavelengths [um]; it reads back as it was saved."""
    lens, view = doublet
    assert view.fields.shape == (9, 2) and view.wavelengths_um == (0.6563, 0.5893, 0.4861)
    assert math.degrees(math.atan(float(view.radii.max()) / view.efl)) == pytest.approx(34.4, abs=1e-9)
    for name in ("saved.yaml", "saved.zmx"):
        tasklens.save_lens(tmp_path / name, lens, view)
        again, its_view = tasklens.load_lens(tmp_path / name)
        assert torch.equal(again.curvature, lens.curvature) and torch.equal(again.thickness, lens.thickness)
        assert float(its_view.tangents.max()) == pytest.approx(float(view.tangents.max()), rel=1e-9)
    with pytest.raises(InputError, match="pixel_pitch_um = -3: expected greater"):
        tasklens.load_lens(HEADLINE / "doublet-imaging2.yaml", pixel_pitch_um=-3)


def test_a_changed_value_leaves_the_others_of_a_saved_lens(tmp_path):
    """Focal length, F-number, fields and pixels are those of the saved lens, unless one is changed."""
    lens, view = tasklens.lens(COOKE, field_of_view_deg=40, f_number=5, pixel_pitch_um=4, kernel_size=31)
    tasklens.save_lens(tmp_path / "cooke.yaml", lens, view)
    for changes in ({"pixel_pitch_um": 3, "kernel_size": 21}, {"f_number": 8}, {"field_of_view_deg": 30}):
        its_lens, its_view = tasklens.load_lens(tmp_path / "cooke.yaml", **changes)
        figures = tasklens.analyse(its_lens, its_view, rays=64)
        expected = {"pixel_pitch_um": 4, "kernel_size": 31, "f_number": 5, "field_of_view_deg": 40} | changes
        assert its_view.efl == view.efl and its_view.pixel_pitch_um == expected["pixel_pitch_um"]
        assert its_view.kernel_size == expected["kernel_size"]
        assert figures["f_number"] == pytest.approx(expected["f_number"], rel=1e-9)
        assert 2 * max(figures["angle_deg"]) == pytest.approx(expected["field_of_view_deg"], abs=1e-9)
    coloured = tasklens.load_lens(tmp_path / "cooke.yaml", wavelengths_um=numpy.array([0.6, 0.5, 0.45]))[1]
    assert coloured.wavelengths_um == (0.6, 0.5, 0.45)


def test_a_lens_that_a_file_cannot_hold_is_not_written(doublet, tmp_path):
    """One with a melt, which would be read as nominal, and one that diverged."""
    lens, view = doublet
    melt = Melt(torch.zeros_like(lens.curvature), torch.zeros_like(lens.curvature), view.reference_um)
    built, diverged = replace(lens, melt=melt), replace(lens, curvature=lens.curvature * torch.nan)
    for name in ("lens.yaml", "lens.zmx"):
        with pytest.raises(InputError, match="remove `pose` and `melt`"):
            tasklens.save_lens(tmp_path / name, built, view)
        with pytest.raises(InputError, match="curvature of the lens is not finite; nothing was written"):
            tasklens.save_lens(tmp_path / name, diverged, view)
    assert not any(tmp_path.iterdir())


def test_traced_rays_arrive_where_first_order_optics_says(doublet):
    """Chief rays near the axis at height efl tan(angle) in the paraxial focal plane [mm]; shapes as documented."""
    lens, view = doublet
    rays = tasklens.trace(lens, view, rays=32)
    assert rays.x.shape == rays.n.shape == (9, 3, 32) and rays.valid.all()
    torch.testing.assert_close(rays.l**2 + rays.m**2 + rays.n**2, torch.ones_like(rays.x), rtol=0, atol=1e-12)
    near = replace(view, fields=view.fields * 1e-4)
    chief = tasklens.trace(lens, near, pupil=torch.zeros(1, 2, dtype=torch.float64))
    first_order = paraxial(lens, view.reference_um)
    height = chief.y + (first_order.bfl - lens.thickness[-1]) * chief.m / chief.n
    torch.testing.assert_close(height[:, 1, 0], near.tangents[:, 1] * first_order.efl, rtol=1e-6, atol=1e-12)


def test_psfs_have_the_spots_that_analyse_measures(doublet):
    """The RMS radius of the light on the pixels, without their own second moment, is that of the rays [um]."""
    lens, view = doublet
    grid = tasklens.psf(lens, view)
    analysis = tasklens.analyse(lens, view)
    assert grid.shape == (9, 3, view.kernel_size, view.kernel_size)
    assert grid.sum((-2, -1)).mean(1).tolist() == pytest.approx(analysis["energy_in_window"], abs=1e-3)
    at = view.pixel_pitch_um * (torch.arange(view.kernel_size) - view.kernel_size // 2).to(grid.dtype)
    light = grid.sum(1) / grid.sum((1, 2, 3))[:, None, None]
    x, y = (light * at).sum((1, 2)), (light * at[:, None]).sum((1, 2))
    variance = (light * (at**2 + at[:, None] ** 2)).sum((1, 2)) - x**2 - y**2 - view.pixel_pitch_um**2 / 6
    assert variance.sqrt().tolist() == pytest.approx(analysis["rms_centroid_um"], rel=0.1)
    assert analysis["core_radius_um"][0] < analysis["radius_80_um"][0]


def test_captures_are_of_the_same_image_by_file_array_or_tensor(doublet, tmp_path):
    """In [0, 1], one for each field, with gradients in the image; also reversed channels of OpenCV, and 16 bits."""
    lens, view = doublet
    values = numpy.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=numpy.uint8)
    image = Image.fromarray(values)
    image.save(tmp_path / "image.png")
    tensor = torch.from_numpy(values).movedim(-1, 0).float() / 255
    wide = values.astype(numpy.uint16) * 257
    fields = [(0.0, 0.0), (1.0, 0.6)]
    expected = tasklens.simulate(lens, view, tmp_path / "image.png", fields, rays=64)
    assert expected.shape == (2, 3, 40, 48) and expected.min() >= 0 and expected.max() <= 1
    reversed_twice = values[..., ::-1].copy()[..., ::-1]
    for other in (values, values / 255, tensor, reversed_twice, image, wide, torch.from_numpy(wide).movedim(-1, 0)):
        capture = tasklens.simulate(lens, view, other, fields, rays=64)
        torch.testing.assert_close(capture.float(), expected.float(), rtol=0, atol=1e-6)
    assert tasklens.simulate(lens, view, tensor, rays=64).shape == (9, 3, 40, 48)
    leaf = tensor.clone().requires_grad_()
    tasklens.simulate(lens, view, leaf, fields[:1], rays=64).sum().backward()
    assert float(leaf.grad.mean()) == pytest.approx(1, abs=1e-3)  # each pixel's light arrives


def test_a_lens_typed_surface_by_surface():
    """The Cooke triplet of Zemax's samples: EFL 50 mm; its image without a distance is in focus."""
    lens, view = tasklens.lens(COOKE, field_of_view_deg=40, f_number=5)
    figures = tasklens.analyse(lens, view, rays=64)
    assert figures["efl_mm"] == pytest.approx(50.0, abs=0.03) and figures["f_number"] == pytest.approx(5, rel=1e-9)
    assert max(figures["angle_deg"]) == pytest.approx(20, abs=1e-9) and lens.stop == 3
    with pytest.warns(UserWarning, match=r"no light arrives at \d of 9 fields"):
        tasklens.lens([{**COOKE[0], "alpha_4": 5.0}, *COOKE[1:]], field_of_view_deg=40, f_number=5)
    focused, _ = tasklens.lens([*COOKE[:-1], {"radius": -18.39533}], field_of_view_deg=40, f_number=5)
    assert float(focused.thickness[-1]) == pytest.approx(42.2, abs=0.3)
    numbers = {"material": (1.62041, 60.32), "conic": -0.5, "alpha_4": 1e-6, "semi_diameter": 9.0}
    typed, _ = tasklens.lens([COOKE[0] | numbers, *COOKE[1:]], field_of_view_deg=40, f_number=5)
    assert typed.refractive_indices((0.5876,))[1] == pytest.approx(1.62041, abs=1e-5)
    assert typed.alpha[0].tolist() == [0, 1e-6] and float(typed.conic[0]) == -0.5 and float(typed.semi_diameter[0]) == 9


def test_colours_do_not_depend_on_the_order_of_wavelengths(doublet):
    """Red is the longest wavelength; green is the reference, which is the middle one in the list, or between them."""
    _, view = doublet
    for wavelengths, colours in (
        ((0.4861, 0.5876, 0.6563), (0.6563, 0.5876, 0.4861)),
        ((0.4861, 0.6563), (0.6563, 0.6563, 0.4861)),
        ((0.55,), (0.55, 0.55, 0.55)),
        ((0.45, 0.65, 0.5), (0.65, 0.5, 0.45)),
        ((0.7, 0.45, 0.6, 0.5, 0.65), (0.7, 0.6, 0.45)),
    ):
        assert replace(view, wavelengths_um=wavelengths).in_colours().wavelengths_um == colours


def test_a_notebook_shows_a_lens(doublet):
    """The display has the cross-section and a row for each surface; `draw` makes a full figure."""
    lens, view = doublet
    html = lens._repr_html_()
    assert html.count("<tr>") == len(lens.media) + 1 and html.count("<path") == 2 + 3 and "OKP4" in html
    assert "nan" not in html and "inf" not in html
    media = (*lens.media[:-2], replace(lens.media[-2], name="<b>mine"), lens.media[-1])
    assert "<b>" not in replace(lens, media=media)._repr_html_()
    assert len(tasklens.draw(lens, view, "mine", rays=64).get_children()) > 1
    assert tasklens.__version__ == importlib.metadata.version("tasklens")


def test_a_typed_image_distance_is_kept():
    """Also for a near object, which the prescription is for."""
    surfaces = [{"radius": 10.0, "thickness": 2.0, "material": "PMMA", "stop": True}, {"radius": -10.0, "thickness": 9}]
    lens, view = tasklens.lens(surfaces, field_of_view_deg=4, f_number=8, object_distance_mm=60)
    assert float(lens.thickness[-1]) == 9 and view.object_distance == pytest.approx(60)


def test_a_design_in_a_notebook():
    short = {"descents": {"0": {"steps": 3}}}
    lens, view, notes = tasklens.design_lens("spot", ["COC"], settings=short, kernel_size=11, field_of_view_deg=40)
    assert view.kernel_size == 11 and len(lens.media) == len(lens.curvature)
    assert {"spec", "origin", "figures", "margins"} <= set(notes) and notes["origin"]["method"] == "descents"
    assert notes["figures"]["efl_mm"] == pytest.approx(tasklens.analyse(lens, view)["efl_mm"], rel=1e-12)
    with pytest.raises(InputError, match=r"spec\.f_number = 'fast': expected a number"):
        tasklens.design_lens("spot", ["COC"], f_number="fast")


def test_a_design_starts_from_a_lens_in_memory(tmp_path):
    """The same as from its file."""
    lens, view = tasklens.load_lens(HEADLINE / "doublet-tasklens.yaml")
    tasklens.save_lens(tmp_path / "lens.yaml", lens, view)
    settings = {"descents": {"0": {"steps": 2}}}
    first, _, _ = tasklens.design_lens("spot", start=(lens, view), settings=settings)
    second, _, _ = tasklens.design_lens("spot", start=tmp_path / "lens.yaml", settings=settings)
    assert torch.equal(first.curvature, second.curvature) and not torch.equal(first.curvature, lens.curvature)


def test_keywords_of_a_design_are_keys_of_the_specification():
    """Types cannot derive them."""
    assert Specification.__annotations__.keys() == {*Spec.model_fields, "configuration"}
