"""Tensors, arrays and files that a function cannot take: one line that says what is possible."""

import io
from dataclasses import replace
from pathlib import Path

import numpy
import pytest
import torch
from examples import HEADLINE
from torch import nn
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp, vmap
from torch.fx.experimental.proxy_tensor import make_fx

import tasklens
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.runtime.errors import InputError
from tasklens.runtime.tensors import as_tensor

ROOT = Path(__file__).parents[1]
FILE = HEADLINE / "doublet-imaging3.yaml"
IMAGE = torch.rand(3, 40, 40, generator=torch.Generator().manual_seed(0))
PAIRS = [(IMAGE, k % 3) for k in range(3)]


LENS, VIEW = tasklens.load_lens(FILE, kernel_size=15)
VIEW = replace(VIEW, fields=VIEW.fields[[0, 8]])
CURVATURE = LENS.curvature
CAMERA = tasklens.Camera(LENS, VIEW, rays=64)
PSFS = tasklens.psf(LENS, VIEW.in_colours(), rays=64).float()
NETWORK = nn.Sequential(nn.Flatten(), nn.Linear(3 * 40 * 40, 3))

OF_LENS = {  # functions of a lens, whose answer is a number
    "trace": lambda lens: tasklens.trace(lens, VIEW, 16).x.sum(),
    "psf": lambda lens: tasklens.psf(lens, VIEW, 16).square().sum(),
    "simulate": lambda lens: tasklens.simulate(lens, VIEW, IMAGE, rays=16).square().sum(),
    "simulate_whole_sensor": lambda lens: tasklens.simulate_whole_sensor(lens, VIEW, IMAGE, 5.0, rays=16).sum(),
    "analyse": lambda lens: tasklens.analyse(lens, VIEW, 16)["efl_mm"] + lens.curvature.sum(),
    "Camera": lambda lens: tasklens.Camera(lens, VIEW, rays=16)(IMAGE[None], [0]).sum(),
    "draw": lambda lens: tasklens.draw(lens, VIEW, rays=16),
    "save_lens": lambda lens: tasklens.save_lens("/nowhere/lens.yaml", lens, VIEW),
    "rank": lambda lens: tasklens.rank({"mine": (lens, VIEW)}, PAIRS, NETWORK, rays=16),
    "design_lens": lambda lens: tasklens.design_lens("spot", start=(lens, VIEW)),
}
OF_IMAGES = {  # functions of images
    "simulate": lambda images: tasklens.simulate(LENS, VIEW, images[0], rays=16).sum(),
    "simulate_whole_sensor": lambda images: tasklens.simulate_whole_sensor(LENS, VIEW, images[0], 5.0, rays=16).sum(),
    "Camera": lambda images: CAMERA(images, [0]).sum(),
    "Camera.all_fields": lambda images: CAMERA.all_fields(images).sum(),
    "PsfCamera": lambda images: tasklens.PsfCamera(PSFS)(images, [0]).sum(),
    "PsfCamera.all_fields": lambda images: tasklens.PsfCamera(PSFS).all_fields(images).sum(),
}
TRANSFORMS = {
    "grad": lambda function, value: grad(function)(value),
    "jvp": lambda function, value: jvp(function, (value,), (value,)),
    "jacrev": lambda function, value: jacrev(function)(value),
    "jacfwd": lambda function, value: jacfwd(function)(value),
    "hessian": lambda function, value: hessian(function)(value),
    "vmap": lambda function, value: vmap(function)(torch.stack([value, value])),
}
TRANSFORMED = "inside vmap or torch.func: take derivatives by backward"


def assert_one_line(call, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        call()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("door", list(OF_LENS)[:6])
def test_transforms_of_functions_of_a_lens(door):
    """Every transform of one door, and one of the others."""

    def function(curvature):
        return OF_LENS[door](replace(LENS, curvature=curvature))

    for name in TRANSFORMS if door == "psf" else ("jvp",):
        assert_one_line(lambda name=name: TRANSFORMS[name](function, CURVATURE), TRANSFORMED)


@pytest.mark.parametrize("door", OF_IMAGES)
def test_transforms_of_functions_of_images(door):
    for name in TRANSFORMS if door == "Camera" else ("vmap",):
        assert_one_line(lambda name=name: TRANSFORMS[name](OF_IMAGES[door], IMAGE[None]), TRANSFORMED)


def test_transforms_of_parameters_and_of_a_backward_pass():
    parameters = dict(CAMERA.named_parameters())
    assert_one_line(lambda: grad(lambda p: functional_call(CAMERA, p, (IMAGE[None], [0])).sum())(parameters), "Camera")

    def both(curvature):
        rays = tasklens.trace(replace(LENS, curvature=curvature), VIEW, 16)
        return torch.stack([rays.x.sum(), rays.y.square().sum()])

    jacobian = torch.autograd.functional.jacobian
    assert_one_line(lambda: jacobian(both, CURVATURE, vectorize=True), TRANSFORMED)
    assert jacobian(both, CURVATURE).shape == (2, len(CURVATURE))


def test_a_trace_with_its_pupil_is_transformed():
    """As the line says: the gradient is that of `backward`."""
    pupil, curvature = sobol_disc(16, seed=0), CURVATURE.clone().requires_grad_()

    def spot(curvature):
        return tasklens.trace(replace(LENS, curvature=curvature), VIEW, pupil=pupil).x.square().sum()

    spot(curvature).backward()
    torch.testing.assert_close(grad(spot)(CURVATURE), curvature.grad, rtol=1e-12, atol=0)
    slope = jvp(spot, (CURVATURE,), (torch.ones_like(CURVATURE),))[1]
    torch.testing.assert_close(slope, curvature.grad.sum(), rtol=1e-9, atol=0)
    assert_one_line(lambda: jacrev(spot)(CURVATURE), "trace|Trace")


class Module(nn.Module):
    """A function of images as a module, which torch exports with the modules that it uses."""

    def __init__(self, function, *used):
        super().__init__()
        self.function, self.used = function, nn.ModuleList(used)

    def forward(self, images):
        return self.function(images)


@pytest.mark.filterwarnings("ignore")  # torch's, of the trace
@pytest.mark.parametrize("door", ["simulate", "simulate_whole_sensor", "Camera", "Camera.all_fields"])
def test_optics_are_not_exported(door):
    """Neither by torch.export, nor by a trace; a `PsfCamera` is exported as the line says."""
    words = "optics cannot be exported or traced by torch: export the network alone"
    module = Module(OF_IMAGES[door], CAMERA)
    for export in (
        lambda: torch.export.export(module, (IMAGE[None],)),
        lambda: torch.jit.trace(module, IMAGE[None]),
        lambda: make_fx(module)(IMAGE[None]),
    ):
        assert_one_line(export, words)


def test_a_camera_of_fixed_psfs_is_exported():
    """And keeps its captures: an export leaves nothing behind."""
    camera, other = tasklens.PsfCamera(PSFS), IMAGE[None].flip(-1)
    expected = tasklens.PsfCamera(PSFS)(other, [0])
    exported = torch.export.export(Module(lambda images: camera(images, [0])), (IMAGE[None],)).module()
    assert torch.equal(exported(other), expected) and torch.equal(camera(other, [0]), expected)


def on_meta(value):
    return replace(value, **{k: v.to("meta") for k, v in vars(value).items() if isinstance(v, torch.Tensor)})


@pytest.mark.parametrize("door", OF_LENS)
def test_a_lens_without_values(door):
    assert_one_line(lambda: OF_LENS[door](on_meta(LENS)), r"without values \(device meta\): a lens needs its values")


@pytest.mark.parametrize("door", OF_IMAGES)
def test_images_without_values(door):
    for images in (IMAGE[None], (255 * IMAGE[None]).byte())[: 2 if door.startswith("simulate") else 1]:
        assert_one_line(lambda images=images: OF_IMAGES[door](images.to("meta")), r"without values \(device meta\)")


def test_other_values_on_meta():
    """A view, pupil points, PSFs, a camera, a network, images of a data set."""
    for call in (
        lambda: tasklens.psf(LENS, on_meta(VIEW)),
        lambda: tasklens.trace(LENS, VIEW, pupil=torch.zeros(3, 2, device="meta")),
        lambda: tasklens.PsfCamera(PSFS.to("meta"))(IMAGE[None], [0]),
        lambda: tasklens.Camera(LENS, VIEW, rays=16).to("meta")(IMAGE[None]),
        lambda: tasklens.rank(
            {"mine": (LENS, VIEW)}, PAIRS, nn.Sequential(nn.Flatten(), nn.Linear(4800, 3, device="meta"))
        ),
        lambda: tasklens.rank({"mine": (LENS, VIEW)}, [(IMAGE.to("meta"), 0)], NETWORK),
    ):
        assert_one_line(call, r"without values \(device meta\)")


@pytest.mark.parametrize("kind", ["f2", "f8", "u2"])
def test_images_of_any_byte_order(kind):
    """And with strides below zero."""
    array = ((65535 if kind == "u2" else 1) * IMAGE.permute(1, 2, 0).numpy()).astype(kind)[::-1, :, ::-1]
    native = tasklens.simulate(LENS, VIEW, array.copy(), rays=16)
    for order in "<>":
        flipped = array.astype(order + kind, order="K")
        torch.testing.assert_close(tasklens.simulate(LENS, VIEW, flipped, rays=16), native)


def test_numbers_of_any_byte_order():
    """Pupil points, fields, indices of fields and labels."""
    points = numpy.array([[0.0, 0.1], [0.2, 0.3]])
    for values in (points.astype(">f8"), points[::-1].copy()[::-1]):
        assert torch.equal(tasklens.trace(LENS, VIEW, pupil=values).x, tasklens.trace(LENS, VIEW, pupil=points).x)
    fields = numpy.zeros((1, 2), ">f8")
    assert torch.equal(
        tasklens.simulate(LENS, VIEW, IMAGE, fields, rays=16), tasklens.simulate(LENS, VIEW, IMAGE, [(0, 0)], rays=16)
    )
    assert torch.equal(CAMERA(IMAGE[None], numpy.array([1], ">i8")), CAMERA(IMAGE[None], [1]))
    labelled = [(IMAGE.permute(1, 2, 0).numpy().astype(">f4"), numpy.array(k, ">i4")) for k in range(3)]
    with pytest.warns(UserWarning, match="too few images"):
        tasklens.rank({"mine": (LENS, VIEW)}, labelled, NETWORK, rays=16)


@pytest.mark.parametrize("kind", [object, str, bytes, complex, numpy.longdouble, "M8[s]", [("red", "u1")]])
def test_arrays_of_other_kinds_are_refused(kind):
    array = numpy.zeros((40, 40, 3), kind)
    assert_one_line(lambda: tasklens.simulate(LENS, VIEW, array), "image: expected .*, got")
    if kind is not complex:
        assert_one_line(lambda: as_tensor(array, "values"), "values: expected numbers, as a tensor, an array or a list")
    for call in (lambda: CAMERA(array), lambda: tasklens.PsfCamera(array)):
        assert_one_line(call, "expected a tensor .*, got ndarray")


@pytest.mark.parametrize("file", [io.BytesIO(b"one"), (ROOT / "README.md").open()], ids=["bytes", "text"])
@pytest.mark.parametrize(
    "door, words",
    [
        (lambda file: tasklens.load_lens(file), "path: expected the path of a file, got"),
        (lambda file: tasklens.load_lens(FILE, [file]), "catalogues: expected the path of a file, got"),
        (lambda file: tasklens.save_lens(file, LENS, VIEW), "path: expected the path of a file, got"),
        (lambda file: tasklens.design_lens(start=file), "start: expected the path of a lens file, or a lens"),
        (lambda file: tasklens.simulate(LENS, VIEW, file), r"got an open file, .*; give PIL.Image.open\(file\)"),
        (lambda file: tasklens.rank({"a": (LENS, VIEW)}, file, NETWORK), "images: expected a folder, or pairs"),
        (lambda file: tasklens.rank({"a": (LENS, VIEW)}, [(file, 0)], NETWORK), "number 0: .* got an open file"),
        (lambda file: tasklens.design_lens("task", images=file, network=NETWORK), "images: expected a folder"),
    ],
)
def test_open_files_are_refused(door, words, file):
    assert_one_line(lambda: door(file), words)


def test_paths_of_other_kinds_are_refused():
    for path in (b"lens.yaml", None, 3):
        assert_one_line(lambda path=path: tasklens.load_lens(path), "path: expected the path of a file, got")
