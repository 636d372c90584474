"""Capture of an image by the whole sensor, through a lens."""

from typing import Literal

from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.simulation.blend import SensorPsfs, blend
from tasklens.simulation.sensor_psfs import pitch_on_sensor, trace_sensor_psfs

Colour = Literal["srgb", "linear"]


def simulate(
    lens: Lens,
    view: View,
    image: Tensor,
    pixel_pitch: float | None = None,
    rays: int = 4096,
    colour: Colour = "srgb",
    distortion: bool = False,
    illumination: bool = False,
) -> Tensor:
    """Capture an image (3, H, W) of sRGB values in [0, 1] and any size with the whole sensor: (3, H, W).

    The centre of the image is on the axis. For several images through one lens, call `trace_sensor_psfs` once and
    `capture` for each image.

    Args:
        lens: a rotationally symmetric lens.
        view: its fields, focal length, wavelengths and pixel pitch; the largest field is the corner of the sensor.
        pixel_pitch: pixel pitch [um]; None: the pitch at which the image fills the sensor (`pitch_on_sensor`).
        rays: number of pupil points for each PSF and colour.
        colour: blur sRGB values ("srgb", as in the captures of a study) or "linear" light.
        distortion: distort the image; if False, it has the geometry of a pinhole camera.
        illumination: darken the image by the relative illumination; if False, exposure compensates for it.

    Raises:
        InputError: the image has a wrong shape or is too small, or the lens forms no image at the corners.
    """
    shape = _size(image)
    pitch = pixel_pitch or pitch_on_sensor(view, shape)
    return capture(image, trace_sensor_psfs(lens, view, shape, pitch, rays, distortion, illumination), colour)


def capture(image: Tensor, psfs: SensorPsfs, colour: Colour = "srgb") -> Tensor:
    """Capture an image (3, H, W) of sRGB values with traced PSFs; differentiable in both.

    Raises:
        InputError: the image has a wrong shape, or is too small.
    """
    _size(image)
    if colour == "linear":
        return linear_rgb_to_rgb(blend(rgb_to_linear_rgb(image), psfs))
    return blend(image, psfs, linear=False)


def _size(image: Tensor) -> tuple[int, int]:
    if image.dim() != 3 or image.shape[0] != 3 or not image.is_floating_point():
        raise InputError(f"image of shape {tuple(image.shape)}, {image.dtype}: expected (3, H, W) in floating point")
    return image.shape[1], image.shape[2]
