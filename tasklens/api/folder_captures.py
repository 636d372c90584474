"""Captures of a folder of photographs, to train or to test a network elsewhere."""

import sys
import warnings
from collections import Counter
from pathlib import Path

import torch

from tasklens.api.captures import check_light
from tasklens.camera.imaging import PsfCamera, check_capture, noise
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.lens import Lens
from tasklens.optics.psf import energy_inside, window_remark
from tasklens.optics.view import View, drawn_points
from tasklens.recognition import class_folders, folders, user_images
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import write_rows
from tasklens.runtime.progress import Progress
from tasklens.settings.capture_settings import SensorSettings
from tasklens.show.image_files import write_captures

FIELDS = "fields.csv"  # of the captures
_DRAWS = 8  # draws of nine fields
_BLOCK = 64  # photographs in memory


def capture_folder(
    folder: Path,
    output: Path,
    lens: Lens,
    view: View,
    size: int = user_images.SIZE,
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
    if words := class_folders.passed_over(folder, others):
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
        samples = None if sensor is None else noise(images.shape, generator)
        for name, capture in zip(names[block], camera(images, fields[block], samples), strict=True):
            path = output / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_captures(path, capture[None])
        progress(min(first + _BLOCK, len(files)))
    return len(files)
