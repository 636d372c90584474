"""What a notebook has: shapes, units, gradients, and help that can be read."""

import inspect
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy
import pytest
import torch
from examples import difference

import tasklens
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.runtime.errors import InputError

PUBLISHED = Path(__file__).parents[1] / "docs" / "results" / "headline" / "lenses"


@pytest.fixture(scope="module")
def doublet():
    return tasklens.load_lens(PUBLISHED / "doublet-imaging2.yaml")


def test_importing_it_loads_nothing_heavy():
    """Neither torch nor numba nor pandas, until a name is asked for; all names are listed."""
    program = (
        "import sys, tasklens; heavy = 'torch', 'numba', 'pandas', 'pydantic'; print(set(heavy) & set(sys.modules))"
        "; print(set(tasklens.__all__) <= set(dir(tasklens))); print(tasklens.psf.__module__, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["set()", "True", "tasklens.notebook True"]


@pytest.mark.parametrize("name", tasklens.__all__)
def test_help_can_be_read(name):
    """A sentence, what every argument is, an example; a wrong name is none."""
    found = getattr(tasklens, name)
    text = inspect.getdoc(found)
    assert text.split("\n")[0].endswith((".", ";")) and f"tasklens.{name}(" in text
    function = found if inspect.isfunction(found) else inspect.unwrap(tasklens.design.__call__)
    for argument in inspect.signature(function).parameters:
        if argument not in ("lens", "view", "arguments", "keywords"):
            assert argument in text, argument
    with pytest.raises(AttributeError, match="tracee"):
        tasklens.tracee  # noqa: B018


def test_a_lens_and_its_view(doublet, tmp_path):
    """Nine fields up to the corner of the sensor [mm], three wavelengths [um]; it reads back as it was saved."""
    lens, view = doublet
    assert view.fields.shape == (9, 2) and view.wavelengths == (0.6563, 0.5893, 0.4861)
    assert math.degrees(math.atan(float(view.radii.max()) / view.efl)) == pytest.approx(34.4, abs=1e-9)
    for name in ("saved.yaml", "saved.zmx"):
        tasklens.save_lens(tmp_path / name, lens, view)
        again, its_view = tasklens.load_lens(tmp_path / name)
        assert torch.equal(again.curvature, lens.curvature) and torch.equal(again.thickness, lens.thickness)
        assert float(its_view.tangents.max()) == pytest.approx(float(view.tangents.max()), rel=1e-9)
    with pytest.raises(InputError, match="pixel_pich_um"):
        tasklens.load_lens(PUBLISHED / "doublet-imaging2.yaml", pixel_pich_um=3)


def test_traced_rays_arrive_where_first_order_optics_says(doublet):
    """Chief rays near the axis at height efl tan(angle) in the paraxial focal plane [mm]; shapes as documented."""
    lens, view = doublet
    rays = tasklens.trace(lens, view, rays=32)
    assert rays.x.shape == rays.n.shape == (9, 3, 32) and rays.valid.all()
    torch.testing.assert_close(rays.l**2 + rays.m**2 + rays.n**2, torch.ones_like(rays.x), rtol=0, atol=1e-12)
    near = replace(view, fields=view.fields * 1e-4)
    chief = tasklens.trace(lens, near, pupil=torch.zeros(1, 2, dtype=torch.float64))
    first_order = paraxial(lens, view.reference)
    height = chief.y + (first_order.bfl - lens.thickness[-1]) * chief.m / chief.n
    torch.testing.assert_close(height[:, 1, 0], near.tangents[:, 1] * first_order.efl, rtol=1e-6, atol=1e-12)


def test_gradient_of_traced_rays(doublet):
    """Of the squared heights by all curvatures, against differences of five points."""
    lens, view = doublet
    curvature = lens.curvature.clone()

    def heights(values: torch.Tensor) -> torch.Tensor:
        rays = tasklens.trace(replace(lens, curvature=values), view, rays=8)
        return (rays.x**2 + rays.y**2).sum()

    leaf = curvature.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(heights(leaf), leaf)
    expected = difference(heights, curvature, 1e-5)
    glass = curvature != 0  # not the stop
    torch.testing.assert_close(gradient[glass], expected[glass], rtol=1e-6, atol=1e-8)
    assert gradient[glass].abs().min() > 0


def test_psfs_have_the_spots_that_analyse_measures(doublet):
    """The RMS radius of the light on the pixels, without their own second moment, is that of the rays [um]."""
    lens, view = doublet
    grid = tasklens.psf(lens, view)
    found = tasklens.analyse(lens, view)
    assert grid.shape == (9, 3, view.kernel_size, view.kernel_size)
    assert grid.sum((-2, -1)).mean(1).tolist() == pytest.approx(found["energy_in_window"], abs=1e-3)
    at = view.pixel_pitch * (torch.arange(view.kernel_size) - view.kernel_size // 2).to(grid.dtype)
    light = grid.sum(1) / grid.sum((1, 2, 3))[:, None, None]
    x, y = (light * at).sum((1, 2)), (light * at[:, None]).sum((1, 2))
    variance = (light * (at**2 + at[:, None] ** 2)).sum((1, 2)) - x**2 - y**2 - view.pixel_pitch**2 / 6
    assert variance.sqrt().tolist() == pytest.approx(found["rms_centroid_um"], rel=0.1)
    assert found["core_radius_um"][0] < found["radius_80_um"][0]


def test_captures_are_of_the_same_image_by_file_array_or_tensor(doublet, tmp_path):
    """In [0, 1], one for each field, with gradients in the image."""
    from PIL import Image

    lens, view = doublet
    values = numpy.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=numpy.uint8)
    Image.fromarray(values).save(tmp_path / "image.png")
    tensor = torch.from_numpy(values).movedim(-1, 0).float() / 255
    fields = [(0.0, 0.0), (1.0, 0.6)]
    captures = [
        tasklens.simulate(image, lens, view, fields, rays=64)
        for image in (tmp_path / "image.png", values, values / 255, tensor)
    ]
    assert captures[0].shape == (2, 3, 40, 48) and captures[0].min() >= 0 and captures[0].max() <= 1
    for other in captures[1:]:
        torch.testing.assert_close(other.float(), captures[0].float(), rtol=0, atol=1e-6)
    assert tasklens.simulate(tensor, lens, view, rays=64).shape == (9, 3, 40, 48)
    leaf = tensor.clone().requires_grad_()
    tasklens.simulate(leaf, lens, view, fields[:1], rays=64).sum().backward()
    assert float(leaf.grad.mean()) == pytest.approx(1, abs=1e-3)  # each pixel's light arrives


def test_what_a_capture_cannot_be_made_of(doublet, tmp_path):
    lens, view = doublet
    for image, words in (
        (numpy.zeros((20, 30, 3)), "an image of 30 x 20 pixels is too small for PSFs of 51 pixels"),
        (numpy.zeros((60, 60)), r"expected an array \(H, W, 3\) or a tensor \(3, H, W\), got \(60, 60\)"),
        (tmp_path / "absent.png", "absent.png: no such image"),
    ):
        with pytest.raises(InputError, match=words):
            tasklens.simulate(image, lens, view, rays=64)
    with pytest.raises(InputError, match="expected srgb or linear, got 'rgb'"):
        tasklens.simulate(torch.zeros(3, 60, 60), lens, view, colour="rgb", rays=64)


def test_a_design_in_a_notebook():
    short = {"descents": {"0": {"steps": 3}}}
    lens, view, notes = tasklens.design("spot", ["COC"], settings=short, kernel_size=11, field_of_view_deg=40)
    assert view.kernel_size == 11 and len(lens.media) == len(lens.curvature)
    assert {"spec", "origin", "figures", "margins"} <= set(notes) and notes["origin"]["method"] == "descents"
    assert notes["figures"]["efl_mm"] == pytest.approx(tasklens.analyse(lens, view)["efl_mm"], rel=1e-12)
    with pytest.raises(InputError, match=r"spec\.f_numbre = 2: unknown key; did you mean f_number\?"):
        tasklens.design("spot", ["COC"], f_numbre=2)
