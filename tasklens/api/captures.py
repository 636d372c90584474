"""Captures of an image, or of a folder of photographs, through a lens."""

import sys
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from tasklens.camera.imaging import PsfCamera, check_capture
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.paraxial import check_focal_length
from tasklens.optics.analysis.spots import evaluation_psf, has_light
from tasklens.optics.lens import Lens
from tasklens.optics.psf import energy_inside, window_remark
from tasklens.optics.view import View, drawn_points
from tasklens.recognition import class_folders, folders
from tasklens.recognition.dataset import PHOTOGRAPH_SIZE
from tasklens.recognition.image_tensors import Image, image_tensor
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import write_rows
from tasklens.runtime.progress import Progress
from tasklens.runtime.tensors import as_tensor, explain_errors
from tasklens.settings.capture_settings import SensorSettings
from tasklens.show.image_files import write_captures

FIELDS = "fields.csv"  # of the captures of a folder
_DRAWS = 8  # draws of nine fields
_BLOCK = 64  # photographs in memory


@explain_errors
def simulate(
    lens: Lens,
    view: View,
    image: Image,
    fields: Sequence[tuple[float, float]] | None = None,
    *,
    colour: str | None = None,
    outside_window: str = "veil",
    sensor: SensorSettings | None = None,
    rays: int = 4096,
    diffraction: bool = False,
) -> Tensor:
    """Render captures of an image through the lens, one for each field, as if the whole image were at that field.

    Args:
        image: a file; a Pillow image; an array (H, W, 3) of uint8, uint16, or floats in [0, 1]; or a tensor (3, H, W)
            of uint8, or floats in [0, 1].
        fields: points (x, y), f tan(theta) from the axis [mm]: on the sensor, for an object at infinity; None: the F
            fields of the view.
        colour: "srgb" convolves the sRGB values of the image, "linear" its linear light; None: linear with a sensor,
            sRGB without one.
        outside_window: light outside the PSF window returns as a uniform "veil", or is removed ("renormalise").
        sensor: noise, the same at every call, and quantisation; None: none.
        rays, diffraction: as in `psf`.

    Returns:
        (F, 3, H, W) captures, differentiable in the image and the lens; relative illumination has no gradient. A
        warning says if less than half of the light of a field is inside the PSF window.

    Raises:
        InputError: the image cannot be read, or is smaller than half a PSF; a field is no point or is beyond those of
            the view, or no light arrives there.

    Example:
        >>> captures = tasklens.simulate(lens, view, "cat.jpg", fields=[(0, 0), (1.7, 1.0)])
    """
    source = image_tensor(image)
    check_capture(colour, outside_window, sensor)
    if fields is not None:
        view = replace(view, fields=_on_sensor(fields, view))
    if view.kernel_size // 2 >= min(source.shape[-2:]):
        height, width = source.shape[-2:]
        raise InputError(
            f"an image of {width} x {height} pixels is too small for PSFs of {view.kernel_size} pixels: take a larger "
            "one, or a smaller kernel_size (--kernel-size)"
        )
    view = view.in_colours()
    check_light(lens, view)
    grid = evaluation_psf(lens, view, rays, diffraction)
    if remark := window_remark(energy_inside(grid), view.kernel_size):
        warnings.warn(remark, stacklevel=3)
    illumination = None if sensor is None else relative_illumination(lens.detached(), view)
    camera = PsfCamera(grid, colour=colour, outside_window=outside_window, sensor=sensor, illumination=illumination)
    return camera.all_fields(source[None], torch.Generator().manual_seed(0))[:, 0]


@explain_errors
def simulate_whole_sensor(
    lens: Lens,
    view: View,
    image: Image,
    image_pixel_pitch_um: float | None = None,
    *,
    colour: Literal["srgb", "linear"] = "srgb",
    distortion: bool = False,
    illumination: bool = False,
    rays: int = 4096,
) -> Tensor:
    """Render the capture of an image by the whole sensor: the PSF varies from axis to corner.

    Args:
        image: as in `simulate`, of any size; its centre is on the axis.
        image_pixel_pitch_um: width of a pixel of the image; None: the width at which the image fills the sensor.
        colour: "srgb" convolves the sRGB values of the image, "linear" its linear light.
        distortion: distort the image; if False, it has the geometry of a pinhole camera.
        illumination: darken the image towards its corners; if False, exposure compensates for it.
        rays: number of rays for each PSF and colour.

    Returns:
        (3, H, W) capture, differentiable in the image and the lens; relative illumination has no gradient. A warning
        says if less than half of the light of a field is inside the PSF windows.

    Raises:
        InputError: the image cannot be read or is too small, or the lens forms no image at its corners.

    Example:
        >>> capture = tasklens.simulate_whole_sensor(lens, view, "cat.jpg")  # 1080 x 1920: a quarter of a minute
    """
    from tasklens.camera.blend import capture
    from tasklens.camera.sensor_psfs import pitch_on_sensor, trace_sensor_psfs

    check_capture(colour)
    if image_pixel_pitch_um is not None and not image_pixel_pitch_um > 0:
        raise InputError(f"image_pixel_pitch_um: expected a positive width, got {image_pixel_pitch_um}")
    source, view = image_tensor(image), view.in_colours()
    shape = (source.shape[1], source.shape[2])
    pitch = image_pixel_pitch_um or pitch_on_sensor(lens, view, shape)
    check_focal_length(lens, view.reference_um, "captures need")
    psfs = trace_sensor_psfs(lens, view, shape, pitch, rays, distortion, illumination)
    if remark := window_remark(psfs.energy_inside, 2 * psfs.margin + 1, "take larger pixels of the image"):
        warnings.warn(remark, stacklevel=3)
    return capture(source, psfs, colour)


def check_light(lens: Lens, view: View) -> None:
    """Raise InputError if no light arrives at some field, or if the lens has no positive focal length."""
    check_focal_length(lens, view.reference_um, "captures need")
    if not (light := has_light(lens.detached(), view)).all():
        x, y = view.fields[int((~light).nonzero()[0])].tolist()
        raise InputError(f"no light arrives at the field ({x:g}, {y:g}) mm: all its rays are lost; omit the field")


def _on_sensor(fields: Sequence[tuple[float, float]], view: View) -> Tensor:
    """Return fields (F, 2) [mm]; raises InputError if one is no point or beyond the largest field of the view."""
    points = as_tensor(fields, "fields", view.fields.dtype)
    if points.dim() != 2 or points.shape[1] != 2 or not len(points):
        raise InputError(
            "fields: expected at least one point (x, y) [mm], such as [(1.7, 1.0)], or None for those of the view"
        )
    largest = float(view.radii.max())
    for x, y in points[~(points.norm(dim=-1) <= largest * (1 + 1e-3))].tolist():  # also one that is not a number
        raise InputError(f"field ({x:g}, {y:g}) mm: outside the field, which ends {largest:.3f} mm from the axis")
    return points


def capture_folder(
    folder: Path,
    output: Path,
    lens: Lens,
    view: View,
    size: int = PHOTOGRAPH_SIZE,
    field: int | None = None,
    seed: int = 0,
    colour: str | None = None,
    sensor: SensorSettings | None = None,
    rays: int = 4096,
) -> int:
    """Write a capture of each photograph of a folder, entirely at one field, as PNG, in the same subfolders.

    `fields.csv` lists the field of each capture and its point [mm].

    Args:
        folder: folder of photographs, at any depth.
        output: new folder of the captures.
        size: side of the captures [pixels]: photographs are cropped to their central square and resized.
        field: index of the field of the view for all photographs; None: fields over the whole sensor, drawn by `seed`
            uniformly in area; `seed` also draws noise.
        colour, sensor: as in `tasklens.simulate`.
        rays: number of rays of each field and colour.

    Returns:
        The number of captures.

    Raises:
        InputError: there is no photograph, the output exists, two captures would have the same name, photographs are
            smaller than half a PSF, or no light arrives at a field. Photographs that cannot be read are counted, before
            the first capture.
    """
    files, others = class_folders.contents(folder) if folder.is_dir() else ([], Counter[str]())
    if not files:
        raise InputError(f"{folder}: expected a folder of photographs ({', '.join(class_folders.SUFFIXES)})")
    if words := class_folders.describe_others(folder, others):
        print(f"tasklens: {words}", file=sys.stderr)
    if output.exists():
        raise InputError(f"{output}: already exists; choose a new folder")
    names = [file.relative_to(folder).with_suffix(".png") for file in files]
    if duplicates := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"{folder}: two photographs differ only in their suffix: {min(duplicates).with_suffix('')}")
    if view.kernel_size // 2 >= size:
        raise InputError(f"size {size}: too small for PSFs of {view.kernel_size} pixels; take a larger one")
    check_capture(colour, sensor=sensor)
    view = view.in_colours()
    check_light(lens, view)
    if field is None:
        view = view.at(drawn_points(_DRAWS, seed))
    illumination = None if sensor is None else relative_illumination(lens.detached(), view)
    grid = evaluation_psf(lens.detached(), view, rays)
    if remark := window_remark(energy_inside(grid), view.kernel_size):
        warnings.warn(remark, stacklevel=2)
    camera = PsfCamera(grid, colour=colour, sensor=sensor, illumination=illumination)
    generator = torch.Generator().manual_seed(seed)
    fields = torch.randint(len(view.fields), (len(files),), generator=generator)
    if field is not None:
        fields = torch.full_like(fields, field)
    points = view.fields.tolist()
    rows = ((str(name), k, *points[k]) for name, k in zip(names, fields.tolist(), strict=True))
    table = [dict(zip(("file", "field", "x_mm", "y_mm"), row, strict=True)) for row in rows]
    folders.check_readable(files)
    write_rows(output / FIELDS, table)
    progress = Progress(f"captures of {folder}", len(files))
    for first in range(0, len(files), _BLOCK):
        block = slice(first, first + _BLOCK)
        images = folders.read_all(files[block], size).float() / 255
        samples = None if sensor is None else torch.randn(images.shape, generator=generator)
        for name, capture in zip(names[block], camera(images, fields[block], samples), strict=True):
            path = output / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_captures(path, capture[None])
        progress(min(first + _BLOCK, len(files)))
    return len(files)
