"""Arguments that cannot be used are refused with a message that says what was expected."""

from dataclasses import replace

import pytest
import torch
from examples import HEADLINE
from typed_lenses import COOKE

import tasklens
from tasklens import Camera, PsfCamera, design_lens, load_lens, psf, rank, save_lens, simulate, trace
from tasklens.runtime.errors import InputError

LENS = HEADLINE / "doublet-tasklens.yaml"
IMAGE, NETWORK = torch.full((3, 60, 60), 0.5), torch.nn.Flatten()


@pytest.mark.parametrize(
    "surface, change, words",
    [
        (0, {"radius": 0}, "surface 0: radius: expected a number other than 0"),
        (1, {"curvature": 3}, "surface 1: expected either `radius`"),
        (2, {"semi_diameter": -5}, "surface 2: semi_diameter: expected a radius that is not negative, got -5"),
        (2, {"thickness": "thin"}, "surface 2: thickness: expected a number, got 'thin'"),
        (2, {"material": "F22"}, "unknown glass 'F22'"),
        (4, {"stop": True}, "expected `stop` at one surface, got 2"),
        (0, {"alpha_3": 1e-4}, "unknown key 'alpha_3'"),
        (0, {"material": 1.5}, "name of a glass"),
    ],
)
def test_a_typed_lens_that_cannot_be(surface, change, words):
    surfaces = [*COOKE[:surface], {**COOKE[surface], **change}, *COOKE[surface + 1 :]]
    with pytest.raises(InputError, match=words):
        tasklens.lens(surfaces, field_of_view_deg=40, f_number=5)


@pytest.fixture(scope="module")
def doublet():
    return load_lens(HEADLINE / "doublet-imaging2.yaml")


def dark(lens):
    """The lens with a small last surface, which stops the light of the corner."""
    return replace(lens, semi_diameter=torch.cat([lens.semi_diameter[:-1], torch.tensor([0.2], dtype=torch.float64)]))


def on_axis(view):
    """The view of the first field alone."""
    return replace(view, fields=view.fields[:1])


def tilted(lens):
    """The lens with its first element tilted by 1 mrad."""
    return lens.with_element_moved(0, 1, torch.zeros(2).double(), torch.tensor([1e-3, 0.0]).double())


def single(lens):
    """The lens in single precision."""
    tensors = {name: value for name, value in vars(lens).items() if isinstance(value, torch.Tensor)}
    return replace(lens, **{name: value.float() for name, value in tensors.items()})


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda lens, view: simulate(lens, view, torch.zeros(3, 20, 30)), "30 x 20 pixels is too small for PSFs of"),
        (lambda lens, view: simulate(lens, view, IMAGE[0].numpy()), r"or a tensor \(3, H, W\), got \(60, 60\)"),
        (lambda lens, view: simulate(lens, view, 100 * IMAGE), r"expected floats in \[0, 1\], got 50 to 50; scale"),
        (lambda lens, view: simulate(lens, view, IMAGE - 1), r"got -0\.5 to -0\.5"),
        (lambda lens, view: simulate(lens, view, IMAGE * torch.nan), "got nan to nan"),
        (lambda lens, view: simulate(lens, view, IMAGE.long()), r"uint16 or floats in \[0, 1\], got torch.int64"),
        (lambda lens, view: simulate(lens, view, "absent.png"), "absent.png: no such image"),
        (lambda lens, view: simulate(lens, view, IMAGE, [0, 8]), r"fields: expected at least one point \(x, y\)"),
        (lambda lens, view: simulate(lens, view, IMAGE, colour="rgb"), "colour: expected srgb or linear, got 'rgb'"),
        (
            lambda lens, view: simulate(dark(lens), view, IMAGE, [(1.7, 1.0)]),
            r"no light arrives at the field \(1\.7, 1",
        ),
        (lambda lens, view: simulate(lens, view, IMAGE, [(9, 9)]), r"\(9, 9\) mm: outside the field, which ends 2"),
        (lambda lens, view: simulate(lens, view, IMAGE, [(0, torch.nan)]), r"\(0, nan\) mm: outside the field"),
        (lambda lens, view: trace(lens, view, 1.5), "rays: expected a whole number from 1, got 1.5"),
        (lambda lens, view: tasklens.lens(COOKE, 40, 5, wavelengths_um=0.55), "wavelengths_um: expected a list"),
        (lambda lens, view: tasklens.lens(COOKE, 40, 5, wavelengths_um=()), "wavelengths_um: expected at least one"),
        (lambda lens, view: tasklens.lens(COOKE, 40, 5, wavelengths_um=[0.6, -0.5]), "a positive number, found -0.5"),
        (lambda lens, view: tasklens.lens(COOKE, 40, 5, pixel_pitch_um=-1), "pixel_pitch_um = -1: expected greater"),
        (lambda lens, view: tasklens.lens(COOKE, 40, 5, kernel_size=50), "kernel_size = 50: expected an odd number"),
        (lambda lens, view: tasklens.lens(COOKE, 40, 5, object_distance_mm=0), "object distance 0"),
        (lambda lens, view: tasklens.lens(COOKE, 40, 0), "f_number = 0: expected greater than or equal to 0.5"),
        (lambda lens, view: tasklens.lens(COOKE, 200, 5), "field_of_view_deg = 200: expected less than 150"),
        (lambda lens, view: load_lens(LENS, object_distance_mm="500"), "object_distance_mm: expected a number"),
        (lambda lens, view: Camera(lens, view, free={"curvature": 1}), "free: expected surfaces by variable"),
        (lambda lens, view: Camera(lens, view)(IMAGE), r"images: expected .B, 3, H, W. in .0, 1., got .3, 60"),
        (lambda lens, view: Camera(lens, view)(255 * IMAGE[None]), r"values in \[0, 1\], got 127"),
        (lambda lens, view: rank({"a": (lens, view)}, [(IMAGE, -1)], NETWORK), "numbers of classes"),
        (lambda lens, view: design_lens("spot", loss=torch.dist), "loss: only with a `network`"),
        (lambda lens, view: save_lens("a.yaml", view, lens), "save_lens: expected a path, a lens and its view"),
        (lambda lens, view: rank({"a": "a.zmx"}, [(IMAGE, 0)], NETWORK), "expected lenses by name"),
        (lambda lens, view: PsfCamera(psf(lens, replace(view, wavelengths_um=(0.5,)))), "3 colours"),
        (lambda lens, view: Camera(lens, view)(IMAGE[None], [0.5]), "an index from 0 to 8"),
        (lambda lens, view: Camera(lens, view)(IMAGE[None, :, :8, :8]), "8 x 8 pixels are too small for a kernel"),
        (lambda lens, view: design_lens("spot", free={"curvature": None}), "free: only with `start`"),
        (lambda lens, view: design_lens("spot", ["PMMA"], start=(lens, view)), "elements: not with `start`"),
        (lambda lens, view: design_lens("spot", start=(lens, view), settings={"free": {}}), "give it as `free`"),
        (lambda lens, view: rank({"a": (lens, view)}, [(IMAGE, 0)], NETWORK, size=64), "size: only for a folder"),
        (lambda lens, view: design_lens("spot", start=(lens, view), diagonal_mm=4.0), "diagonal_mm: not with `start`"),
        (lambda lens, view: design_lens("spot", start=(lens, view), configuration=2), "configuration: only for"),
        (lambda lens, view: design_lens("spot", start=(tilted(lens), view)), "start: designs need a nominal lens"),
        (lambda lens, view: trace(lens, view, pupil=[[0, 0, 1]]), r"pupil: expected points \(N, 2\), got"),
        (lambda lens, view: Camera(lens, view, rays=0), "rays: expected a whole number from 1"),
        (lambda lens, view: Camera(single(lens), view), "lens: expected double precision"),
        (lambda lens, view: PsfCamera(psf(lens, view))(IMAGE[None].byte()), r"got \(1, 3, .* torch.uint8"),
        (lambda lens, view: PsfCamera(psf(lens, view)).all_fields(IMAGE), r"expected \(B, 3, H, W\)"),
        (lambda lens, view: tasklens.simulate_whole_sensor(lens, on_axis(view), IMAGE), "no field except the axis"),
        (lambda lens, view: tasklens.simulate_whole_sensor(lens, view, IMAGE[:, :9]), "too small for PSFs of 75"),
        (lambda lens, view: trace(lens, view, 7, torch.zeros(1, 2)), "rays: not with `pupil`"),
    ],
)
def test_arguments_that_cannot_be_used(doublet, call, words):
    with pytest.raises(InputError, match=words):
        call(*doublet)
