"""Rendering of captures from images and PSFs by FFT convolution, and PSNR.

capture = image * PSF + (1 - sum(PSF)) mean(image) = (image - mean(image)) * PSF + mean(image)

The second term is the light outside the PSF window, modelled as a uniform veil, so that the mean flux is conserved.
Borders are reflected. An optional sensor adds noise and quantises (`tasklens.sensor`).
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, get_args

import torch
import torch.nn.functional as F
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from scipy.fft import next_fast_len
from torch import Tensor

from tasklens.runtime.devices import send
from tasklens.runtime.errors import InputError
from tasklens.runtime.first_derivative import FirstDerivative
from tasklens.sensor import expose, noise
from tasklens.study.settings import CaptureSettings, SensorSettings

_IMAGES = 16  # images per block on a CPU
_PLANE_BYTES = 2**20  # size of spectra transformed at once on a CPU, so that they stay in its cache


class _Run(NamedTuple):
    """Consecutive pairs of images, `start` to `stop`, rendered at one field."""

    field: int
    start: int
    stop: int


class _Convolution(torch.autograd.Function):
    """Captures of pairs of images, IFFT(FFT(image - mean) FFT(PSF)) + mean.

    A pair is one complex image: PSFs are real, so its parts do not mix, and one complex transform replaces two real
    transforms without copies. Circular convolution wraps only into K - 1 rows and columns, which are cropped. The
    gradient with respect to a PSF is the correlation of images with the gradients of captures: one inverse transform
    for all images.
    """

    @staticmethod
    def forward(
        ctx: Any,
        images: Tensor,
        mean: Tensor,
        psf: Tensor,
        runs: list[_Run],
        shape: tuple[int, int],
        kernels: Tensor,
    ) -> Tensor:
        """Render captures (N, 2, 3, H, W) of the pairs of each run in turn.

        Args:
            images: (3, P, n, m) spectra of pairs of images with borders, minus their mean.
            mean: (3, P) complex.
            psf: (F, 3, K, K), used only for its gradient.
            runs: the pairs to render at each field.
            shape: height and width of the captures.
            kernels: spectra (F, 3, n, m) of the PSFs, divided by n m.
        """
        captures = psf.new_empty(sum(run.stop - run.start for run in runs), 2, 3, *shape)
        window = _window(psf, shape)
        for field, colours, blocks in _schedule(runs, images):
            for source, target in blocks:
                product = images[colours, source] * kernels[field, colours, None]
                product[..., 0, 0] += mean[colours, source]
                planes = torch.fft.ifft2(product, norm="forward")[window].transpose(0, 1)
                captures[target, 0, colours], captures[target, 1, colours] = planes.real, planes.imag
        ctx.save_for_backward(images, psf)
        ctx.arguments = runs, shape, kernels
        return captures

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the gradients with respect to the spectra of images, their mean, and the PSFs."""

        runs, shape, kernels = ctx.arguments

        def gradients(gradient: Tensor, images: Tensor, psf: Tensor) -> tuple[Tensor | None, ...]:
            return _Convolution._gradients(gradient, images, psf, runs, shape, kernels, ctx.needs_input_grad[0])

        return *FirstDerivative.apply(gradients, gradient, *ctx.saved_tensors), None, None, None

    @staticmethod
    def _gradients(
        gradient: Tensor,
        images: Tensor,
        psf: Tensor,
        runs: list[_Run],
        shape: tuple[int, int],
        kernels: Tensor,
        needs_images: bool,
    ) -> tuple[Tensor | None, ...]:
        at_images = torch.zeros_like(images) if needs_images else None
        at_mean, at_psf = torch.zeros_like(images[..., 0, 0]), torch.zeros_like(psf)
        conjugate = images.conj().resolve_conj()
        padded = torch.zeros_like(images[_colours(images)[0]])
        window = padded[_window(psf, shape)]
        for field, colours, blocks in _schedule(runs, images):
            total = torch.zeros_like(padded[:, 0])
            for source, target in blocks:
                upstream = gradient[target, :, colours].transpose(0, 2)
                count = upstream.shape[2]
                torch.complex(upstream[:, 0], upstream[:, 1], out=window[:, :count])
                product = torch.fft.fft2(padded[:, :count])
                if at_images is not None:
                    at_images[colours, source].addcmul_(product, kernels[field, colours, None].conj())
                    at_mean[colours, source] += product[..., 0, 0]
                for planes in zip(product.unbind(1), conjugate[colours, source].unbind(1), strict=True):
                    total.addcmul_(*planes)
            at_psf[field, colours] += torch.fft.ifft2(total).real[..., : psf.shape[-2], : psf.shape[-1]]
        return at_images, at_mean, at_psf


def _window(psf: Tensor, shape: tuple[int, int]) -> tuple[Any, ...]:
    """Return the slices of the captures in convolved planes (3, P, n, m)."""
    return ..., *(slice(k - 1, k - 1 + side) for k, side in zip(psf.shape[-2:], shape, strict=True))


def _colours(planes: Tensor) -> list[slice]:
    """Return the colours to transform at once: all three on a GPU, so that it has few calls, and one on a CPU."""
    return [slice(0, 3)] if planes.device.type == "cuda" else [slice(colour, colour + 1) for colour in range(3)]


def _schedule(runs: list[_Run], images: Tensor) -> Iterator[tuple[int, slice, list[tuple[slice, slice]]]]:
    """Yield field, colours, and blocks: slices of pairs to transform at once, and slices of their captures."""
    size = _at_once(images)
    begin = 0
    for field, start, stop in runs:
        ends = [(first, min(first + size, stop)) for first in range(start, stop, size)]
        blocks = [(slice(a, b), slice(begin + a - start, begin + b - start)) for a, b in ends]
        for colours in _colours(images):
            yield field, colours, blocks
        begin += stop - start


def _fast_size(pixels: int) -> int:
    """Return the next size with a fast transform: a multiple of four with small factors."""
    return 4 * next_fast_len(-(-pixels // 4))


def _at_once(planes: Tensor) -> int:
    """Return the number of complex planes (..., n, m) to transform at once: all of them on a GPU."""
    count = planes[..., 0, 0].numel()
    return max(1, _PLANE_BYTES * count // planes.nbytes) if planes.device.type == "cpu" else count


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
        self._kernels: dict[tuple[int, int], Tensor] = {}

    @classmethod
    def of(cls, capture: CaptureSettings, psf: Tensor, illumination: Tensor | None) -> "PsfCamera":
        """Build the camera for capture settings, from the PSFs and relative illumination of a PSF file."""
        return cls(
            psf,
            colour=capture.colour,
            outside_window=capture.outside_window,
            sensor=capture.sensor,
            illumination=None if capture.sensor is None else illumination,
        )

    @torch.compiler.disable
    def all_fields(self, images: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Render every image at every field: images (B, 3, H, W) in [0, 1] to (F, B, 3, H, W).

        Args:
            generator: draws the noise, image by image; None: torch's default generator.
        """
        captures = []
        for block in images.split(_IMAGES) if images.device.type == "cpu" else (images,):
            pairs = torch.cat([block, block[: len(block) % 2]]).unflatten(0, (-1, 2))
            runs = [_Run(field, 0, len(pairs)) for field in range(len(self.psf))]
            output = self._render(pairs, runs).unflatten(0, (len(runs), -1))
            captures.append(output.flatten(1, 2)[:, : len(block)])
        output = captures[0] if len(captures) == 1 else torch.cat(captures, 1)
        if self.sensor is None:
            return self._developed(output)
        illumination = self.illumination[:, None].expand(output.shape[:2])
        sample = noise(output.transpose(0, 1).shape, generator or torch.default_generator).transpose(0, 1)
        return self._developed(output, illumination, sample)

    @torch.compiler.disable
    def __call__(
        self, images: Tensor, fields: Sequence[int] | Tensor | None = None, sample: Tensor | None = None
    ) -> Tensor:
        """Render each image at one field: images (B, 3, H, W) in [0, 1] to (B, 3, H, W).

        Args:
            fields: (B,) index of the field of each image; None: random, from torch's default generator.
            sample: (B, 3, H, W) standard normal numbers, the noise of the sensor; None: from torch's default generator.

        Raises:
            InputError: a field that these PSFs do not have, or a sample without a sensor.
        """
        order: list[int] = []  # image indices sorted by field, an even number per field
        runs = []
        fields = field_indices(fields, len(images), len(self.psf))
        numbers = fields.tolist()
        if self.sensor is None and sample is not None:
            raise InputError("sample: only for a camera with a `sensor`")
        if self.sensor is not None and sample is None:
            sample = noise(images.shape, torch.default_generator)
        for field in sorted(set(numbers)):
            indices = [image for image, other in enumerate(numbers) if other == field]
            start = len(order) // 2
            order += indices + indices[: len(indices) % 2]
            runs.append(_Run(field, start, len(order) // 2))
        captures = self._render(images[order].unflatten(0, (-1, 2)), runs).flatten(0, 1)
        position = {image: place for place, image in enumerate(order)}
        output = captures[[position[image] for image in range(len(images))]]
        return self._developed(output, self.illumination[send(fields, output.device)], sample)

    def _developed(self, output: Tensor, illumination: Tensor | None = None, sample: Tensor | None = None) -> Tensor:
        """Return the sRGB values of convolved images: as they are, encoded, or exposed and quantised by the sensor."""
        if self.sensor is None:
            return linear_rgb_to_rgb(output) if self.linear else output
        assert illumination is not None and sample is not None
        light = output if self.linear else rgb_to_linear_rgb(output.clamp(0, 1))
        return expose(light, self.sensor, illumination, sample.to(output))

    def _render(self, images: Tensor, runs: list[_Run]) -> Tensor:
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
        images = images.float().transpose(0, 2)  # colours first
        mean = images.mean((-2, -1), keepdim=True)
        size = _fast_size(height + 2 * half), _fast_size(width + 2 * half)
        # Reflection fills as much of the transform as possible; values beyond the border have no effect.
        far = [min(n - half - side, side - 1) for n, side in zip(size, (height, width), strict=True)]
        padded = F.pad(torch.complex(*(images - mean).unbind(1)), (half, far[1], half, far[0]), mode="reflect")
        means = torch.complex(*mean[..., 0, 0].unbind(1))
        spectra = torch.fft.fft2(padded, size)
        if size not in self._kernels:
            blocks = self.psf.detach().to(spectra.dtype).flatten(0, 1).split(_at_once(spectra))
            kernels = torch.cat([torch.fft.fft2(block, size, norm="forward") for block in blocks])
            self._kernels[size] = kernels.unflatten(0, self.psf.shape[:2])
        return _Convolution.apply(spectra, means, self.psf, runs, (height, width), self._kernels[size])


def field_indices(fields: Sequence[int] | Tensor | None, images: int, count: int) -> Tensor:
    """Return the index (B,) of the field of each of B images, int64; None: random, from torch's default generator.

    Raises:
        InputError: not one index from 0 to `count` - 1 for each image.
    """
    if fields is None:
        return torch.randint(count, (images,))
    indices = torch.as_tensor(fields)
    if (
        indices.is_floating_point()
        or indices.dtype == torch.bool
        or indices.shape != (images,)
        or not ((indices >= 0) & (indices < count)).all()
    ):
        raise InputError(f"fields: expected an index from 0 to {count - 1} for each of {images} images")
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
