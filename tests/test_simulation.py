"""Captures of a whole sensor: against light traced from every pixel; what comes of flux, stars, seams, gradients."""

from dataclasses import replace

import pytest
import torch
from examples import WAVELENGTHS, cooke_triplet, f64
from torch import Tensor

from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.simulation.blend import FieldPsfs, blend
from tasklens.simulation.field_psfs import pitch_on_sensor, trace_field_psfs
from tasklens.simulation.sensor import simulate

SHAPE = (96, 128)
RAYS = 2048


def blurred() -> tuple[Lens, View]:
    """A Cooke triplet out of focus, whose first surface vignettes, and a sensor of 225 um pixels."""
    whole = cooke_triplet()
    distance, clear = whole.thickness.clone(), whole.semi_diameter.clone()
    distance[-1] += 3.0
    clear[0] = 7.5
    fields = f64([[0.0, 0.0], [0.0, 9.0], [0.0, 18.0]])
    return replace(whole, thickness=distance, semi_diameter=clear), View(fields, 50.0, WAVELENGTHS, 225.0, 31)


@pytest.fixture(scope="module")
def traced() -> FieldPsfs:
    lens, view = blurred()
    return trace_field_psfs(lens, view, SHAPE, pitch_on_sensor(view, SHAPE), RAYS)


def noise(shape: tuple[int, int], seed: int) -> Tensor:
    return torch.rand(3, *shape, generator=torch.Generator().manual_seed(seed))


def points(view, shape, pitch) -> Tensor:
    """Points (H, W, 2) of the pixels of a sensor [mm]."""
    rows, columns = (((torch.arange(n) - (n - 1) / 2) * (pitch / 1e3)).double() for n in shape)
    return torch.stack(torch.broadcast_tensors(columns, rows[:, None]), -1)


def traced_from_every_pixel(lens, view, image: Tensor, pitch: float, lit: tuple[slice, slice]) -> Tensor:
    """Follow each ray of the lit pixels to where it ends on the sensor, reflected at the edges of the frame.

    No window, node or transform: four weights per ray.
    """
    height, width = image.shape[1:]
    out = torch.zeros(3, height * width, dtype=torch.float64)
    at = replace(view, fields=points(view, (height, width), pitch)[lit].flatten(0, 1))
    rays, chief = trace_fields(lens, at, sobol_disc(RAYS, seed=0)), chief_points(lens, at)
    pixel = torch.stack(torch.meshgrid(*map(torch.arange, (height, width)), indexing="ij"), -1)[lit].flatten(0, 1)
    light = image[(slice(None), *lit)].flatten(1).T.double()[..., None] / (~rays.vignetted).sum(-1, keepdim=True)
    ends = [
        pixel[:, axis, None, None] + (landed - chief[:, 1 - axis, None, None]) * (1e3 / pitch)
        for axis, landed in enumerate((rays.y, rays.x))
    ]
    for dy in (0, 1):
        for dx in (0, 1):
            weight, index = light * rays.valid, torch.zeros_like(rays.x, dtype=torch.int64)
            for end, step, n in zip(ends, (dy, dx), (height, width), strict=True):
                cell = end.floor() + step
                weight = weight * (1 - (end - cell).abs())
                inside = torch.where(cell < 0, -1 - cell, torch.where(cell > n - 1, 2 * n - 1 - cell, cell))
                assert ((inside >= 0) & (inside < n))[rays.valid].all()
                index = index * n + inside.nan_to_num().clamp(0, n - 1).long()
            for colour in range(3):
                out[colour].index_add_(0, index[:, colour].flatten(), weight[:, colour].flatten())
    return out.unflatten(1, (height, width))


@pytest.mark.parametrize(
    "lit",
    [(slice(40, 56), slice(56, 72)), (slice(40, 56), slice(112, 128)), (slice(0, 16), slice(0, 16))],
    ids=["centre", "edge", "corner"],
)
def test_a_capture_is_that_of_psfs_traced_from_every_pixel(traced, lit):
    """Within 1 % of what the lens does to the image, RMS, at centre, edge and corner."""
    lens, view = blurred()
    image = torch.zeros(3, *SHAPE)
    image[(slice(None), *lit)] = noise((16, 16), seed=1)
    expected = traced_from_every_pixel(lens, view, image, pitch_on_sensor(view, SHAPE), lit)
    error = (blend(image, traced) - expected).square().mean().sqrt()
    assert error < 0.01 * (expected - image).square().mean().sqrt()
