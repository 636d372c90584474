"""From pictures and PSFs to captures: convolution by the fast Fourier transform.

capture = picture * PSF + (1 - sum(PSF)) mean(picture)

The second term is the light that misses the PSF window: it reaches the sensor as a uniform veil, and the mean flux is
conserved. Borders are reflected.
"""

import torch
import torch.nn.functional as F
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor


def _fast_size(size: int) -> int:
    """The next size that is a product of 2, 3 and 5."""
    while True:
        rest = size
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return size
        size += 1


class Camera:
    """Renders captures through a fixed set of PSFs.

    The spectra of the PSFs are kept, with their graph: PSFs that carry a gradient need a new Camera per backward pass.

    Args:
        psf: (F, 3, K, K) one PSF per field and colour, K odd.
        outside: "veil" as above, or "renormalise" the PSF to unit energy, which deletes that light for free.
        colour: light adds up in the values as they are ("srgb", the paper's reading) or in "linear" light.
    """

    def __init__(self, psf: Tensor, outside: str = "veil", colour: str = "srgb"):
        energy = psf.sum((-2, -1), keepdim=True)
        if outside == "renormalise":
            psf, energy = psf / energy.clamp(min=1e-12), torch.ones_like(energy)
        self.psf = psf.float()
        self.veil = (1 - energy).float()
        self.linear = colour == "linear"
        self._spectra: dict[tuple[int, int], Tensor] = {}

    def grid(self, images: Tensor) -> Tensor:
        """Captures of every image at every field: (B, 3, H, W) in [0, 1] to (F, B, 3, H, W)."""
        return self._render(images, lambda values: values[:, None])

    def single(self, images: Tensor, fields: Tensor) -> Tensor:
        """Captures of each image at one field: images (B, 3, H, W) in [0, 1], fields (B,) int64 to (B, 3, H, W)."""
        return self._render(images, lambda values: values[fields])

    def _render(self, images: Tensor, select) -> Tensor:
        height, width = images.shape[-2:]
        half = self.psf.shape[-1] // 2
        if half >= min(height, width):
            raise ValueError(f"images of {height} x {width} pixels are too small for a kernel of {2 * half + 1} pixels")
        if self.linear:
            images = rgb_to_linear_rgb(images)
        size = (_fast_size(height + 2 * half), _fast_size(width + 2 * half))
        if size not in self._spectra:
            self._spectra[size] = torch.fft.rfft2(self.psf, size)
        padded = F.pad(images.float(), (half,) * 4, mode="reflect")
        # The circular convolution wraps only into the border of 2 * half rows and columns that is cut away.
        blurred = torch.fft.irfft2(torch.fft.rfft2(padded, size) * select(self._spectra[size]), size)
        captures = blurred[..., 2 * half : 2 * half + height, 2 * half : 2 * half + width]
        captures = captures + select(self.veil) * images.mean((-2, -1), keepdim=True)
        return linear_rgb_to_rgb(captures) if self.linear else captures


def psnr(images: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio of each image [dB], for values in [0, 1]: -10 log10(mean squared error)."""
    return -10 * torch.log10((images - reference).square().mean((-3, -2, -1)).clamp(min=1e-12))
