"""Lenses, rays, images and networks that several test files share, and finite differences to check gradients."""

import csv
import importlib.util
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import timm
import torch
from PIL import Image
from torch import Tensor, nn

from tasklens.design import descents
from tasklens.materials.catalogues import builtin
from tasklens.materials.material import AIR, Material, model_glass
from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, launch
from tasklens.optics.view import View, view_of_spec
from tasklens.recognition.classifiers import Classifier
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.training import fit
from tasklens.runtime.checkpoints import NO_CHECKPOINT
from tasklens.runtime.files import write_tensors
from tasklens.settings.design_settings import GradientDesignSettings
from tasklens.settings.network_settings import TrainingSettings
from tasklens.settings.specification import Spec

WAVELENGTHS = (0.6563, 0.5893, 0.4861)  # C, d and F lines [um], the middle one the reference
HEADLINE = Path(__file__).parents[1] / "docs/results/headline/lenses"  # published lenses


def f64(values) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64)


def materials(*names: str) -> tuple[Material, ...]:
    """Built-in plastics by name, and air."""
    return tuple(AIR if name == "air" else builtin(name) for name in names)


def make_lens(curvature, thickness, media, *, conic=None, alpha=None, semi_diameter=None, stop=0) -> Lens:
    """A lens in float64; by default spherical, without aspheres and with unlimited apertures; media may be names."""
    surfaces = len(media)
    return Lens(
        curvature=f64(curvature),
        conic=f64(conic if conic is not None else [0.0] * surfaces),
        alpha=f64(alpha) if alpha is not None else torch.zeros(surfaces, 0, dtype=torch.float64),
        thickness=f64(thickness),
        semi_diameter=f64(semi_diameter if semi_diameter is not None else [torch.inf] * surfaces),
        media=tuple(medium if isinstance(medium, Material) else materials(medium)[0] for medium in media),
        stop=stop,
    )


def cooke_triplet(**changes) -> Lens:
    """A Cooke triplet of 50 mm, made for F/5 and 40 degrees, with its stop in the second space and a cover glass."""
    crown, flint = model_glass(1.62041, 60.3, 0.0), model_glass(1.62004, 36.4, 0.0)
    lens = make_lens(
        [1 / 22.01359, -1 / 435.76044, -1 / 22.21328, 1 / 20.29192, 0.0, 1 / 79.6836, -1 / 18.39533, 0.0, 0.0],
        [3.25896, 6.00755, 0.99997, 0.5, 4.25041, 2.95208, 30.0, 1.0, 11.0],
        (crown, "air", flint, "air", "air", crown, "air", "COC", "air"),
        semi_diameter=[torch.inf] * 4 + [4.0] + [torch.inf] * 4,
        stop=4,
    )
    return replace(lens, **changes)


def hyperboloid(shift: float = 0.0, f: float = 50.0, radius: float = 0.5) -> Lens:
    """A plano-hyperboloid, k = -n^2, that images the axis perfectly at `shift` in front of the image plane."""
    n = float(make_lens([0.0], [1.0], ("COC",)).refractive_indices(WAVELENGTHS[1:2])[1, 0])
    curvature, thickness = [0.0, -1 / (f * (n - 1))], [1.0, f + shift]
    return make_lens(curvature, thickness, ("COC", "air"), conic=[0, -(n**2)], semi_diameter=[radius, torch.inf])


def random_lens(seed: int) -> Lens:
    """A stop and two elements with random conics and aspheres up to alpha_10."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    size = f64([0.02, 0.05, 0.05, 0.04, 0.03])  # of alpha_2 .. alpha_10
    lens = make_lens(
        uniform(-0.3, 0.3, 5),
        uniform(0.3, 0.6, 5),
        ("air", "COC", "air", "OKP4", "air"),
        conic=uniform(-2.0, 1.0, 5),
        alpha=uniform(-1.0, 1.0, 5, 5) * size,
    )
    flat_stop = f64([0.0, 1.0, 1.0, 1.0, 1.0])
    return replace(lens, curvature=lens.curvature * flat_stop, alpha=lens.alpha * flat_stop[:, None])


def lens_and_view() -> tuple[Lens, View]:
    """A short real lens with its stop in front, and a view of three of its fields."""
    view = view_of_spec(Spec(kernel_size=31))
    fields = view.fields[[0, 4, 8]] * 0.5
    stopped = replace(random_lens(2), semi_diameter=f64([0.3, *[torch.inf] * 4]))
    return stopped, View(fields, view.efl, view.wavelengths_um, 9.0, 31)


def view_at(tangents, distance: float = math.inf, wavelengths=WAVELENGTHS[1:2], along=(0.0, 1.0)) -> View:
    """Fields by their tangents, (x, y) or along a direction, for a pinhole of 1 mm and objects at a distance [mm]."""
    tangents = f64(tangents)
    fields = tangents if tangents.dim() == 2 else tangents[:, None] * f64(along)
    return View(fields, 1.0, wavelengths, 9.0, 31, 1 / distance)


def cooke_file(path: Path, **changes) -> Path:
    """A Zemax file of the Cooke triplet, with fields on the axis and at 20 degrees."""
    fields = ("angle_deg", ((0.0, 0.0), (0.0, 20.0)))
    source = Prescription(cooke_triplet(), fields=fields, wavelengths_um=(0.6563, 0.5876, 0.4861), primary=1)
    zemax.write(path, replace(source, **changes))
    return path


def random_rays(count: int, seed: int, height: float = 0.4, tangent: float = 0.25) -> Rays:
    """(1, count) rays from the first vertex plane."""
    generator = torch.Generator().manual_seed(seed)
    x, y, tx, ty = 2 * torch.rand(4, 1, count, generator=generator, dtype=torch.float64) - 1
    n = torch.rsqrt(1 + (tangent * tx) ** 2 + (tangent * ty) ** 2)
    return launch(height * x, height * y, torch.zeros_like(n), tangent * tx * n, tangent * ty * n, n)


def parallel_rays(heights) -> Rays:
    """(1, N) rays along the axis at heights y."""
    y = f64(heights)[None]
    zero = torch.zeros_like(y)
    return launch(zero, y, zero, zero, zero, torch.ones_like(y))


def rays_on_image(x, y, valid=None) -> Rays:
    """Rays that meet the image plane at (x, y), any shape; lost where not `valid`."""
    x, y = f64(x), f64(y)
    rays = launch(x, y, torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x), torch.ones_like(x))
    return rays if valid is None else replace(rays, status=(~valid).to(torch.int8))


def difference(function: Callable[[Tensor], Tensor], x: Tensor, step: float) -> Tensor:
    """Derivative of `function` by each element of x, from five points: exact for polynomials of degree 4."""
    columns = []
    for i in range(x.numel()):
        unit = torch.zeros_like(x).flatten()
        unit[i] = step
        unit = unit.reshape(x.shape)
        near, far = function(x + unit) - function(x - unit), function(x + 2 * unit) - function(x - 2 * unit)
        columns.append((8 * near - far) / (12 * step))
    stacked = torch.stack(columns, -1)
    return stacked.reshape(*stacked.shape[:-1], *x.shape)


def assert_derivative(function: Callable[[Tensor], Tensor], value: Tensor, step: float, seed: int, rtol: float) -> None:
    """Assert that reverse and forward mode agree with differences along a random change, relative to the largest."""
    change = torch.randn(value.shape, generator=torch.Generator().manual_seed(seed), dtype=value.dtype)
    expected = difference(lambda t: function(value + t * change), f64(0.0), step)
    scale = float(expected.abs().max())
    assert 0 < scale < math.inf
    reverse = (torch.autograd.functional.jacobian(function, value) * change).flatten(expected.dim()).sum(-1)
    forward = torch.func.jvp(function, (value,), (change,))[1]
    assert_close(reverse, expected, rtol * scale)
    assert_close(forward, reverse, 1e-9 * scale)


def assert_close(actual: Tensor, expected, atol: float) -> None:
    """Assert that every element is within `atol` of the expected one, or of one number."""
    expected = torch.as_tensor(expected, dtype=actual.dtype).expand_as(actual)
    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)


def random_images(count: int, size: int, classes: int, seed: int) -> ImageDataset:
    """Images of noise, each class brighter than the one before."""
    generator = torch.Generator().manual_seed(seed)
    labels = torch.arange(count) % classes
    noise = torch.randint(0, 128, (count, 3, size, size), generator=generator)
    bright = labels[:, None, None, None] * (127 // max(1, classes - 1))
    return ImageDataset((noise + bright).byte(), labels, tuple(f"class{k}" for k in range(classes)))


def random_image(shape: tuple[int, int], seed: int) -> Tensor:
    """An image (3, H, W) of random colours from 0 to 1."""
    return torch.rand(3, *shape, generator=torch.Generator().manual_seed(seed))


def write_photographs(folder: Path, images: ImageDataset, classes: tuple[str, ...]) -> None:
    """Write images as folder/<class>/<number>.png."""
    for k, (image, label) in enumerate(zip(images.images, images.labels.tolist(), strict=True)):
        path = folder / classes[label] / f"{k}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image.permute(1, 2, 0).numpy()).save(path)


def small_network(seed: int) -> nn.Module:
    """A network of one convolution for three classes, with a batch norm and dropout."""
    torch.manual_seed(seed)
    layers = nn.Conv2d(3, 8, 3, stride=2), nn.BatchNorm2d(8), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten()
    return nn.Sequential(*layers, nn.Dropout(0.1), nn.Linear(8, 3))


def trained_network(seed: int, **settings) -> nn.Module:
    """The small network after training on random images of three classes."""
    network = small_network(0)
    settings = TrainingSettings(**({"epochs": 4, "learning_rate": 1e-2, "batch_size": 10} | settings))
    fit(network, random_images(60, 16, 3, seed=1), settings, seed, "test")
    return network


def trained_resnet(path: Path, images: ImageDataset, **training) -> Path:
    """The file of weights of a small ResNet after training on images."""
    torch.manual_seed(0)
    classifier = Classifier(timm.create_model("test_resnet", num_classes=len(images.classes)))
    fit(classifier, images, TrainingSettings(**({"learning_rate": 1e-2} | training)), 0, "test")
    write_tensors(path, classifier.network.state_dict(), {})
    return path


def by_descents(start, criterion, problem, *parts, candidates=None, checkpoint=NO_CHECKPOINT, **design):
    """Design a lens by descents; return the lens, the origin for its file, and the history."""
    options = {"batch_size": 4, "rays": 16, "augment": False, "start": tuple(candidates or ()) or "flat"}
    settings = GradientDesignSettings(descents=parts, **(options | design))
    return descents.design(start, candidates or {}, criterion, problem, settings, checkpoint)[:3]


def load_script(path: Path) -> ModuleType:
    """A program of tools, examples or docs/results as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def write(path: str | Path, text: str) -> None:
    """Write a text file, and the folders that it needs."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))
