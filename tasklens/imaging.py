"""Rendering of captures from images and PSFs by FFT convolution, and PSNR.

capture = image * PSF + (1 - sum(PSF)) mean(image)

The second term is the light outside the PSF window, modelled as a uniform veil, so that the mean flux is conserved.
Borders are reflected.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from scipy.fft import next_fast_len
from torch import Tensor

_BLOCK = 8  # images that a CPU renders at once, so that their spectra and those of their captures fit the cache


def _spectrum(planes: Tensor, size: tuple[int, int]) -> Tensor:
    """Compute the 2D spectrum of real planes (..., h, w), zero-padded to `size`: (..., w / 2 + 1, h), transposed.

    The transposition halves the cost of the inverse transform along the columns, which are contiguous.
    """
    return torch.fft.fft(torch.fft.rfft(planes, size[1]).transpose(-1, -2), size[0])


def _at_once(images: Tensor) -> int:
    """Return the number of images that are rendered at once: all on a GPU."""
    return _BLOCK if images.device.type == "cpu" else len(images)


class Camera:
    """A renderer of captures through a fixed set of PSFs.

    The spectra of the PSFs are cached with their graph: PSFs that require a gradient need a new Camera per backward
    pass.

    Args:
        psf: (F, 3, K, K) one PSF per field and colour, K odd.
        outside_window: "veil" as above, or "renormalise" the PSF to unit energy, without light outside the window.
        colour: convolution of sRGB values ("srgb", our reading of the paper) or of "linear" light.
    """

    def __init__(self, psf: Tensor, outside_window: str = "veil", colour: str = "srgb"):
        energy = psf.sum((-2, -1), keepdim=True)
        if outside_window == "renormalise":
            psf, energy = psf / energy.clamp(min=1e-12), torch.ones_like(energy)
        self.psf = psf.float()
        self.veil = (1 - energy).float()
        self.linear = colour == "linear"
        self._spectra: dict[tuple[int, int], Tensor] = {}

    def grid(self, images: Tensor) -> Tensor:
        """Render every image at every field: images (B, 3, H, W) in [0, 1] to (F, B, 3, H, W)."""
        blocks = []
        for block in images.split(_at_once(images)):
            render, kernels = self._prepare(block)
            blocks.append(torch.stack([render(*kernel) for kernel in zip(kernels, self.veil, strict=True)]))
        return torch.cat(blocks, 1)

    def single(self, images: Tensor, fields: Tensor) -> Tensor:
        """Render each image at one field: images (B, 3, H, W) in [0, 1], fields (B,) int64 to (B, 3, H, W)."""
        captures = []
        for block, chosen in zip(images.split(_at_once(images)), fields.split(_at_once(images)), strict=True):
            render, kernels = self._prepare(block)
            captures.append(render(kernels[chosen], self.veil[chosen]))
        return torch.cat(captures)

    def _prepare(self, images: Tensor) -> tuple[Callable[[Tensor, Tensor], Tensor], Tensor]:
        """Compute what all fields share.

        Returns:
            A function from spectra of PSFs and their veils, one for all images or one each, to captures (B, 3, H, W);
            and the spectra of all PSFs (F, 3, w, h).

        Raises:
            ValueError: the images are smaller than half of the PSF window.
        """
        height, width = images.shape[-2:]
        half = self.psf.shape[-1] // 2
        if half >= min(height, width):
            raise ValueError(f"images of {height} x {width} pixels are too small for a kernel of {2 * half + 1} pixels")
        if self.linear:
            images = rgb_to_linear_rgb(images)
        size = (next_fast_len(height + 2 * half), next_fast_len(width + 2 * half))
        if size not in self._spectra:
            self._spectra[size] = _spectrum(self.psf, size)
        spectra = _spectrum(F.pad(images.float(), (half,) * 4, mode="reflect"), size)
        mean = images.mean((-2, -1), keepdim=True)

        def render(kernel: Tensor, veil: Tensor) -> Tensor:
            # Circular convolution wraps only into the border of 2 * half rows and columns that is cropped: rows before
            # the second transform, which is then smaller.
            rows = torch.fft.ifft(spectra * kernel)[..., 2 * half : 2 * half + height].transpose(-1, -2)
            captures = torch.fft.irfft(rows, size[1])[..., 2 * half : 2 * half + width] + veil * mean
            return linear_rgb_to_rgb(captures) if self.linear else captures

        return render, self._spectra[size]


def psnr(images: Tensor, reference: Tensor) -> Tensor:
    """Compute the PSNR of each image [dB], for values in [0, 1]: -10 log10(mean squared error)."""
    return -10 * torch.log10((images - reference).square().mean((-3, -2, -1)).clamp(min=1e-12))
