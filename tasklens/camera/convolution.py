"""Convolution of images with PSFs by FFT, with one gradient for all images of a field."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from scipy.fft import next_fast_len
from torch import Tensor

from tasklens.runtime.first_derivative import FirstDerivative
from tasklens.runtime.tensors import explain_errors

_PLANE_BYTES = 2**20  # size of spectra transformed at once on a CPU, so that they stay in its cache


class Run(NamedTuple):
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
        ctx: Any, images: Tensor, mean: Tensor, psf: Tensor, runs: list[Run], shape: tuple[int, int], kernels: Tensor
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
                planes = torch.fft.ifft2(product, norm="forward")[window]
                captures[target, :, colours] = torch.view_as_real(planes).permute(1, 4, 0, 2, 3)
        ctx.save_for_backward(images, psf)
        ctx.arguments = runs, shape, kernels
        return captures

    @staticmethod
    @explain_errors
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the gradients with respect to the spectra of images, their mean, and the PSFs."""
        runs, shape, kernels = ctx.arguments

        def gradients(gradient: Tensor, images: Tensor, psf: Tensor) -> tuple[Tensor | None, ...]:
            at_images = torch.zeros_like(images) if ctx.needs_input_grad[0] else None
            at_mean, at_psf = torch.zeros_like(images[..., 0, 0]), torch.zeros_like(psf)
            conjugate = images.conj().resolve_conj()
            padded = torch.zeros_like(images[_colours(images, runs)[0], : _longest(runs)])
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

        return *FirstDerivative.apply(gradients, gradient, *ctx.saved_tensors), None, None, None


def _window(psf: Tensor, shape: tuple[int, int]) -> tuple[Any, ...]:
    """Return the slices of the captures in convolved planes (3, P, n, m)."""
    return ..., *(slice(k - 1, k - 1 + side) for k, side in zip(psf.shape[-2:], shape, strict=True))


def _longest(runs: list[Run]) -> int:
    """Return the largest number of pairs of a run."""
    return max(run.stop - run.start for run in runs)


def _colours(planes: Tensor, runs: list[Run]) -> list[slice]:
    """Return the colours to transform at once: all three if they fit with every run, for few calls; else one."""
    fit = planes.device.type == "cuda" or 3 * _longest(runs) <= _at_once(planes)
    return [slice(0, 3)] if fit else [slice(colour, colour + 1) for colour in range(3)]


def _schedule(runs: list[Run], images: Tensor) -> Iterator[tuple[int, slice, list[tuple[slice, slice]]]]:
    """Yield field, colours, and blocks: slices of pairs to transform at once, and slices of their captures."""
    size, together = _at_once(images), _colours(images, runs)
    begin = 0
    for field, start, stop in runs:
        ends = [(first, min(first + size, stop)) for first in range(start, stop, size)]
        blocks = [(slice(a, b), slice(begin + a - start, begin + b - start)) for a, b in ends]
        for colours in together:
            yield field, colours, blocks
        begin += stop - start


def _fast_size(pixels: int) -> int:
    """Return the next size with a fast transform: a multiple of four with small factors."""
    return 4 * next_fast_len(-(-pixels // 4))


def _at_once(planes: Tensor) -> int:
    """Return the number of complex planes (..., n, m) to transform at once: all of them on a GPU."""
    count = planes[..., 0, 0].numel()
    return max(1, _PLANE_BYTES * count // planes.nbytes) if planes.device.type == "cpu" else count


def convolve(images: Tensor, psf: Tensor, runs: list[Run], spectra_of_psf: dict[tuple[int, int], Tensor]) -> Tensor:
    """Convolve pairs of images with PSFs: (image - mean) * PSF + mean, with reflected borders.

    Args:
        images: (P, 2, 3, H, W) pairs of images, larger than half of the PSF window.
        psf: (F, 3, K, K).
        runs: the pairs to render at each field.
        spectra_of_psf: spectra of these PSFs by the size of the transform; a missing one is added, except in an
            export.

    Returns:
        (N, 2, 3, H, W), in the order of the runs.
    """
    height, width = images.shape[-2:]
    half = psf.shape[-1] // 2
    images = images.float().transpose(0, 2)  # colours first
    mean = images.mean((-2, -1), keepdim=True)
    size = _fast_size(height + 2 * half), _fast_size(width + 2 * half)
    # Reflection fills as much of the transform as possible; values beyond the border have no effect.
    far = [min(n - half - side, side - 1) for n, side in zip(size, (height, width), strict=True)]
    padded = F.pad(torch.complex(*(images - mean).unbind(1)), (half, far[1], half, far[0]), mode="reflect")
    means = torch.complex(*mean[..., 0, 0].unbind(1))
    spectra = torch.fft.fft2(padded, size)
    kernels = spectra_of_psf.get(size)
    if kernels is None:
        kernels = torch.fft.fft2(psf.detach().to(spectra.dtype), size, norm="forward")
        if not torch.compiler.is_exporting():  # otherwise it has no values, and later captures would be noise
            spectra_of_psf[size] = kernels
    return _Convolution.apply(spectra, means, psf, runs, (height, width), kernels)
