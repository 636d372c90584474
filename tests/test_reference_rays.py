"""Rays traced to 40 digits by another program: those of tests/data, and all of them if ../shared exists."""

import json

import numpy
import pytest
import torch
from examples import WAVELENGTHS, assert_close, f64
from reference_files import SHIPPED, original_of
from reference_lenses import tabulated_lens

from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.lens import Lens
from tasklens.optics.rays import launch
from tasklens.optics.tracing.trace import trace_full


def entries(name: str) -> list[dict]:
    """Lenses of a file by name: every lens is traced once, with more rays if ../shared has more."""
    path = SHIPPED / "reference" / name
    files = [json.loads(file.read_text()) for file in (path, original_of(path)) if file.exists()]
    return list({entry["name"]: entry for file in files for entry in file["lenses"]}.values())


LENSES = entries("rays.json")
TILTED = {f"{entry['name']} {case['id']}": (entry, case) for entry in entries("tilted.json") for case in entry["cases"]}


def numbers(values) -> torch.Tensor:
    """Numbers of a file, which may be text."""
    return f64(numpy.array(values, dtype=float))


def assert_rays(lens: Lens, reference: dict, image: float, direction: float, path: float, z=0.0) -> None:
    """Points on the image plane and on every surface [mm], directions and paths [mm]; `z` of the surfaces' vertices."""
    origin, cosines = (numbers(reference[key]).to(lens.dtype) for key in ("origin", "direction"))
    indices = lens.refractive_indices((reference["wavelength_um"],))
    rays, record = trace_full(lens, launch(*origin.T[:, None], *cosines), indices)
    assert rays.valid.all()
    assert_close(torch.stack([rays.x[0], rays.y[0]], -1).double(), numbers(reference["image_xy"]), image)
    cosines = torch.stack([rays.l[0], rays.m[0], rays.n[0]], -1).double()
    assert_close(cosines, numbers(reference["image_direction"]), direction)
    assert_close(rays.path[0].double(), numbers(reference["optical_path"]), path)
    if "surface_points" in reference:
        points = torch.stack([torch.stack([r.x[0], r.y[0], r.z[0]], -1) for r in record], 1).double()
        points[..., 2] += z
        assert_close(points, numbers(reference["surface_points"]), image)


@pytest.mark.parametrize("entry", LENSES, ids=lambda e: e["name"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
def test_rays(entry, dtype):
    lens = tabulated_lens(entry, dtype)
    tolerances = (1e-12, 1e-13, 1e-12)
    if dtype == torch.float32:
        tolerances = [max(1e-5, scale * entry["image_z"]) for scale in (3e-7, 3e-7, 1.3e-6)]
    for reference in entry["traces"]:
        assert_rays(lens, reference, *tolerances)


def posed_lens(entry: dict, case: dict) -> Lens:
    """The lens of the file, moved by our own methods."""
    nominal = lens = tabulated_lens(entry)
    for i, surface in enumerate(case["surfaces"]):
        lens = lens.with_surface_moved(i, f64(surface["decentre"]), f64(surface["tilt"]))
    for move in case["element_moves"]:
        first, *_, last = move["surfaces"]
        lens = lens.with_element_moved(first, last, f64(move["decentre"]), f64(move["tilt"]))
    object.__setattr__(lens, "table", nominal.table)
    return lens


@pytest.mark.parametrize("name", TILTED)
def test_rays_through_moved_surfaces(name):
    """Poses, points on every surface and on the image plane within 1e-12 mm, directions 1e-13, paths 1e-12 mm."""
    lens, (_, case) = posed_lens(*TILTED[name]), TILTED[name]
    for i, surface in enumerate(case["surfaces"]):
        assert_close(lens.pose.rotation[i], numbers(surface["rotation"]), 1e-15)
        nominal = f64([0.0, 0.0, lens.vertices[i]])
        assert_close(lens.pose.position[i] + nominal, numbers(surface["position"]), 2e-14)
    for reference in case["traces"]:
        assert_rays(lens, reference, 1e-12, 1e-13, 1e-12, z=lens.vertices)


@pytest.mark.parametrize("entry", LENSES, ids=lambda e: e["name"])
def test_paraxial(entry):
    lens, expected = tabulated_lens(entry), entry["paraxial"]
    for i, wavelength in enumerate(WAVELENGTHS):
        first_order = paraxial(lens, wavelength)
        for name in ("efl", "bfl", "entrance_pupil_z"):
            assert float(getattr(first_order, name)) == pytest.approx(expected[name][i], rel=0, abs=1e-10)
