"""Rendering of captures from images and PSFs, and PSNR.

capture = image * PSF + (1 - sum(PSF)) mean(image) = (image - mean(image)) * PSF + mean(image)

The second term is the light outside the PSF window, modelled as a uniform veil, so that the mean flux is conserved.
Borders are reflected. An optional sensor adds noise and quantises (`exposure`).
"""

from collections.abc import Sequence
from typing import get_args

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from tasklens.camera.convolution import Run, convolve
from tasklens.camera.exposure import expose
from tasklens.runtime.devices import send
from tasklens.runtime.errors import InputError
from tasklens.runtime.tensors import as_tensor, explain_errors
from tasklens.settings.capture_settings import CaptureSettings, SensorSettings

_IMAGES = 16  # images per block on a CPU


class PsfCamera:
    """A renderer of captures through a fixed set of PSFs, whose spectra are cached.

    Args:
        psf: (F, 3, K, K) one PSF per field and colour (red, green, blue), K odd.
        colour: convolution of sRGB values ("srgb", our interpretation of the paper) or of "linear" light; None: linear
            with a sensor, sRGB without one.
        outside_window: "veil" as above, or "renormalise": PSFs of unit energy, without light outside the window.
        sensor: sensor; None: no noise and no quantisation.
        illumination: (F,) relative illumination of the fields, only with a sensor; None: 1 everywhere.

    Raises:
        InputError: PSFs of another shape, or another argument that is unknown.

    Example:
        >>> camera = tasklens.PsfCamera(tasklens.psf(lens, view).float())
        >>> captures = camera(images, [0, 8])  # images (2, 3, H, W): on the axis, in the corner
    """

    @explain_errors
    def __init__(
        self,
        psf: Tensor,
        *,
        colour: str | None = None,
        outside_window: str = "veil",
        sensor: SensorSettings | None = None,
        illumination: Tensor | None = None,
    ):
        check_capture(colour, outside_window, sensor)
        if not isinstance(psf, Tensor):
            raise InputError(f"psf: expected a tensor (fields, 3 colours, K, K), got {type(psf).__name__}")
        if psf.dim() != 4 or psf.shape[1] != 3 or psf.shape[-1] != psf.shape[-2] or psf.shape[-1] % 2 == 0:
            raise InputError(
                f"psf: expected (fields, 3 colours, K, K) with an odd K, got {tuple(psf.shape)}; `view.in_colours()` "
                "has red, green and blue"
            )
        if illumination is not None and sensor is None:
            raise InputError("illumination: only with a `sensor`, which corrects it after the exposure")
        if illumination is not None and illumination.shape != psf.shape[:1]:
            raise InputError(f"illumination: expected ({len(psf)},), got {tuple(illumination.shape)}")
        if outside_window == "renormalise":
            psf = psf / psf.sum((-2, -1), keepdim=True).clamp(min=1e-12)
        self.psf = psf.float()
        self.linear = sensor is not None if colour is None else colour == "linear"
        self.sensor = sensor
        self.illumination = (psf.new_ones(len(psf)) if illumination is None else illumination).to(self.psf)
        self._spectra: dict[tuple[int, int], Tensor] = {}

    @classmethod
    def of(cls, capture: CaptureSettings, psf: Tensor, illumination: Tensor | None) -> "PsfCamera":
        """Build the camera for capture settings; `illumination` is not used without a sensor."""
        return cls(
            psf,
            colour=capture.colour,
            outside_window=capture.outside_window,
            sensor=capture.sensor,
            illumination=None if capture.sensor is None else illumination,
        )

    @torch.compiler.disable
    @explain_errors
    def all_fields(
        self, images: Tensor, generator: torch.Generator | None = None, fields: Sequence[int] | None = None
    ) -> Tensor:
        """Render every image at every field: images (B, 3, H, W) in [0, 1] to (F, B, 3, H, W).

        Args:
            generator: draws the noise, image by image; None: torch's default generator.
            fields: indices of the fields; None: all.

        Raises:
            InputError: images of another shape or type, or a field that these PSFs do not have.
        """
        check_images(images)
        fields = range(len(self.psf)) if fields is None else field_indices(fields, None, len(self.psf)).tolist()
        captures = []
        for block in images.split(_IMAGES) if images.device.type == "cpu" else (images,):
            pairs = torch.cat([block, block[: len(block) % 2]]).unflatten(0, (-1, 2))
            runs = [Run(field, 0, len(pairs)) for field in fields]
            output = self._render(pairs, runs).unflatten(0, (len(runs), -1))
            captures.append(output.flatten(1, 2)[:, : len(block)])
        output = captures[0] if len(captures) == 1 else torch.cat(captures, 1)
        if self.sensor is None:
            return self._develop(output)
        illumination = self.illumination[list(fields), None].expand(output.shape[:2])
        # A draw of several images together can end in other numbers: torch draws in blocks of 16.
        sample = torch.stack([torch.randn(output[:, 0].shape, generator=generator) for _ in images], 1)
        return self._develop(output, illumination, sample)

    @torch.compiler.disable
    @explain_errors
    def __call__(
        self, images: Tensor, fields: Sequence[int] | Tensor | None = None, sample: Tensor | None = None
    ) -> Tensor:
        """Render each image at one field: images (B, 3, H, W) in [0, 1] to (B, 3, H, W).

        Args:
            fields: (B,) index of the field of each image; None: random, from torch's default generator.
            sample: (B, 3, H, W) standard normal numbers, the noise of the sensor; None: from torch's default generator.

        Raises:
            InputError: images of another shape or type, a field that these PSFs do not have, or a sample without a
                sensor or of another shape.
        """
        order: list[int] = []  # image indices sorted by field, an even number per field
        runs = []
        check_images(images)
        fields = field_indices(fields, len(images), len(self.psf))
        numbers = fields.tolist()
        if self.sensor is None and sample is not None:
            raise InputError("sample: only for a camera with a `sensor`")
        if self.sensor is not None:
            sample = torch.randn(images.shape) if sample is None else as_tensor(sample, "sample")
        if sample is not None and sample.shape != images.shape:
            raise InputError(
                f"sample: expected the shape of the images, {tuple(images.shape)}, got {tuple(sample.shape)}"
            )
        for field in sorted(set(numbers)):
            indices = [image for image, other in enumerate(numbers) if other == field]
            start = len(order) // 2
            order += indices + indices[: len(indices) % 2]
            runs.append(Run(field, start, len(order) // 2))
        captures = self._render(images[order].unflatten(0, (-1, 2)), runs).flatten(0, 1)
        position = {image: place for place, image in enumerate(order)}
        output = captures[[position[image] for image in range(len(images))]]
        return self._develop(output, self.illumination[send(fields, output.device)], sample)

    def _develop(self, output: Tensor, illumination: Tensor | None = None, sample: Tensor | None = None) -> Tensor:
        """Return the sRGB values of convolved images: as they are, encoded, or exposed and quantised by the sensor."""
        if self.sensor is None:
            return linear_rgb_to_rgb(output) if self.linear else output
        assert illumination is not None and sample is not None
        light = output if self.linear else rgb_to_linear_rgb(output.clamp(0, 1))
        return expose(light, self.sensor, illumination, sample.to(output))

    def _render(self, images: Tensor, runs: list[Run]) -> Tensor:
        """Convolve pairs of images (P, 2, 3, H, W) to (N, 2, 3, H, W), in the order of the runs, in their colour space.

        Raises:
            InputError: the images are smaller than half of the PSF window.
        """
        height, width = images.shape[-2:]
        half = self.psf.shape[-1] // 2
        if half >= min(height, width):
            raise InputError(f"images of {height} x {width} pixels are too small for a kernel of {2 * half + 1} pixels")
        if self.linear:
            images = rgb_to_linear_rgb(images)
        return convolve(images, self.psf, runs, self._spectra)


def check_images(images: Tensor) -> None:
    """Raise InputError for other images than (B, 3, H, W) of floating-point numbers."""
    if not isinstance(images, Tensor):
        raise InputError(f"images: expected a tensor (B, 3, H, W) in [0, 1], got {type(images).__name__}")
    if images.dim() != 4 or images.shape[1] != 3 or not images.is_floating_point() or not len(images):
        raise InputError(f"images: expected (B, 3, H, W) in [0, 1], got {tuple(images.shape)} of {images.dtype}")


def field_indices(fields: Sequence[int] | Tensor | None, images: int | None, count: int) -> Tensor:
    """Return the index (B,) of the field of each of B images, int64; None: random, from torch's default generator.

    Args:
        images: B; None: any number from 1.

    Raises:
        InputError: not one index from 0 to `count` - 1 for each image.
    """
    if fields is None:
        assert images is not None
        return torch.randint(count, (images,))
    indices = as_tensor(fields, "fields")
    if (
        indices.is_floating_point()
        or indices.dtype == torch.bool
        or indices.shape != (len(indices) if images is None and indices.dim() else images,)
        or not ((indices >= 0) & (indices < count)).all()
    ):
        each = "" if images is None else f" for each of {images} images"
        raise InputError(f"fields: expected an index from 0 to {count - 1}{each}")
    return indices.long()


def check_capture(colour: str | None, outside_window: str = "veil", sensor: SensorSettings | None = None) -> None:
    """Raise InputError for an unknown `colour` or `outside_window`, or a `sensor` that is none."""
    if sensor is not None and not isinstance(sensor, SensorSettings):
        raise InputError(f"sensor: expected a tasklens.SensorSettings, got {sensor!r}")
    for name, value in (("colour", "srgb" if colour is None else colour), ("outside_window", outside_window)):
        expected = get_args(CaptureSettings.model_fields[name].annotation)
        if value not in expected:
            raise InputError(f"{name}: expected {' or '.join(expected)}, got {value!r}")


def psnr(images: Tensor, reference: Tensor) -> Tensor:
    """Compute the PSNR of each image [dB], for values in [0, 1]: -10 log10(mean squared error)."""
    return -10 * torch.log10((images - reference).square().mean((-3, -2, -1)).clamp(min=1e-12))
