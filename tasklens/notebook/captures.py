"""Captures in a notebook: what a sensor sees of an image through a lens."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from tasklens.notebook.lenses import psf
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import lit
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.recognition.image_tensor import Image, image_tensor
from tasklens.runtime.errors import InputError

if TYPE_CHECKING:
    from tasklens.study.settings import SensorSettings


def simulate(
    image: Image,
    lens: Lens,
    view: View,
    fields: Sequence[tuple[float, float]] | None = None,
    *,
    colour: str = "srgb",
    outside_window: str = "veil",
    sensor: "SensorSettings | None" = None,
    rays: int = 4096,
    diffraction: bool = False,
) -> Tensor:
    """Render what the sensor sees of an image through the lens, once for each field, as if all of it lay there.

    Args:
        image: a file; a Pillow image; an array (H, W, 3) of uint8, uint16, or floats in [0, 1]; or a tensor (3, H, W)
            of uint8, or floats in [0, 1].
        fields: points (x, y) on the sensor [mm]; None: the F fields of the view.
        colour: "srgb" convolves the values of the image, "linear" its light.
        outside_window: light beside the PSF window returns as a "veil", or is removed: "renormalise".
        sensor: noise and levels, a `tasklens.study.settings.SensorSettings`; None: none.
        rays, diffraction: as in `psf`.

    Returns:
        (F, 3, H, W) captures, differentiable in the image and in the lens, whose relative illumination is held.

    Raises:
        InputError: the image cannot be read, or is smaller than half a PSF; a field is not on the sensor, or no light
            arrives there.

    Example:
        >>> captures = tasklens.simulate("cat.jpg", lens, view, fields=[(0, 0), (1.7, 1.0)])
    """
    from tasklens.imaging import PsfCamera

    source = image_tensor(image)
    check_choices(colour, outside_window)
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
    grid = psf(lens, view, rays, diffraction)
    camera = PsfCamera(grid, outside_window, colour, sensor, relative_illumination(lens.detached(), view))
    return camera.grid(source[None])[:, 0]


def simulate_sensor(
    image: Image,
    lens: Lens,
    view: View,
    pixel_pitch_um: float | None = None,
    *,
    colour: Literal["srgb", "linear"] = "srgb",
    distortion: bool = False,
    illumination: bool = False,
    rays: int = 4096,
) -> Tensor:
    """Render what the whole sensor sees of an image through the lens: the PSF changes from axis to corner.

    Args:
        image: as in `simulate`, of any size; its centre is on the axis.
        pixel_pitch_um: width of a pixel of the image; None: the one at which the image fills the sensor.
        colour: "srgb" convolves the values of the image, "linear" its light.
        distortion: distort the image; otherwise it has the geometry of a pinhole camera.
        illumination: darken the image towards its corners; otherwise exposure makes up for it.
        rays: number of rays of each PSF and colour.

    Returns:
        (3, H, W) capture, differentiable in the image and in the lens, whose relative illumination is held.

    Raises:
        InputError: the image cannot be read or is too small, or the lens has no image at its corners.

    Example:
        >>> capture = tasklens.simulate_sensor("cat.jpg", lens, view)  # 1080 x 1920: a quarter of a minute
    """
    from tasklens.simulation import sensor

    check_choices(colour)
    return sensor.simulate(
        lens, view.in_colours(), image_tensor(image), pixel_pitch_um, rays, colour, distortion, illumination
    )


def check_light(lens: Lens, view: View) -> None:
    """Raise InputError for a lens that lets no light through to some field."""
    if not (light := lit(lens.detached(), view)).all():
        x, y = view.fields[int((~light).nonzero()[0])].tolist()
        raise InputError(f"no light arrives at the field ({x:g}, {y:g}) mm: clear apertures stop it; leave it out")


def check_choices(colour: str, outside_window: str = "veil") -> None:
    """Raise InputError for an unknown kind of colours, or of light outside the window."""
    for value, choices in ((colour, ("srgb", "linear")), (outside_window, ("veil", "renormalise"))):
        if value not in choices:
            raise InputError(f"expected {' or '.join(choices)}, got {value!r}")


def _on_sensor(fields: Sequence[tuple[float, float]], view: View) -> Tensor:
    """Return fields (F, 2) [mm]; raises InputError for one beyond the largest field of the view."""
    points = torch.tensor(fields, dtype=view.fields.dtype).reshape(-1, 2)
    largest = float(view.radii.max())
    for x, y in points[points.norm(dim=-1) > largest * (1 + 1e-3)].tolist():
        raise InputError(f"field ({x:g}, {y:g}) mm: outside the field, which ends {largest:.3f} mm from the axis")
    return points
