"""Files of PSFs and captures: arrays for programs, images for people."""

from pathlib import Path
from typing import Any

import numpy
from PIL import Image
from torch import Tensor

from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf_notes
from tasklens.optics.view import View
from tasklens.runtime.files import replacing, write_tensors

_ZOOM = 4  # pixels of an image of PSFs per pixel of the sensor
_BORDER = 4  # between tiles [pixels]


def write_psf(path: Path, grid: Tensor, lens: Lens, view: View) -> None:
    """Write PSFs (F, W, K, K) in the format of the suffix of `path`.

    .npz and .safetensors hold `psf` and `illumination` (F,), with fields, wavelengths, pixel pitch, and the distance of
    a near object. A .png shows the square root of each PSF divided by its largest value, so that its tail is visible.
    """
    suffix = path.suffix.lower()
    illumination, notes = relative_illumination(lens, view), psf_notes(view, grid)
    if suffix == ".npz":
        arrays: dict[str, Any] = {key: numpy.asarray(value) for key, value in notes.items() if key != "energy_inside"}
        with replacing(path) as temporary, open(temporary, "wb") as file:
            numpy.savez_compressed(file, psf=grid.detach().numpy(), illumination=illumination.numpy(), **arrays)
    elif suffix == ".safetensors":
        write_tensors(path, {"psf": grid.float(), "illumination": illumination.float()}, notes)
    else:
        image = (grid / grid.amax((1, 2, 3), keepdim=True).clamp(min=1e-12)).sqrt()
        order = sorted(range(len(view.wavelengths_um)), key=lambda k: -view.wavelengths_um[k])  # red first
        _save(path, _mosaic(image[:, [order[0], order[len(order) // 2], order[-1]]]), _ZOOM)


def write_captures(path: Path, captures: Tensor) -> None:
    """Write captures (F, 3, H, W) in [0, 1] as one image, a mosaic if there are several."""
    _save(path, captures[0] if len(captures) == 1 else _mosaic(captures), 1)


def _mosaic(tiles: Tensor) -> Tensor:
    """Arrange tiles (F, 3, H, W) row by row in a square mosaic, white between them."""
    count, _, height, width = tiles.shape
    columns = -(-count // max(1, int(count**0.5)))
    rows = -(-count // columns)
    whole = tiles.new_ones(3, rows * (height + _BORDER) - _BORDER, columns * (width + _BORDER) - _BORDER)
    for k, tile in enumerate(tiles):
        top, left = k // columns * (height + _BORDER), k % columns * (width + _BORDER)
        whole[:, top : top + height, left : left + width] = tile
    return whole


def _save(path: Path, image: Tensor, zoom: int) -> None:
    values = (255 * image.detach().clamp(0, 1)).round().byte().movedim(0, -1).numpy()
    pixels = Image.fromarray(numpy.ascontiguousarray(values))
    kind = {".png": "PNG"}.get(path.suffix.lower(), "JPEG")
    with replacing(path) as temporary:
        resized = pixels.resize((zoom * pixels.width, zoom * pixels.height), Image.Resampling.NEAREST)
        resized.save(temporary, kind, quality=95)
