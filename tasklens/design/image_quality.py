"""Criteria of a design for image quality: errors of captures, the spot radius, the contrast of the PSF."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tasklens.design.criteria import CaptureCriterion, FieldCriterion
from tasklens.design.objective import Criterion
from tasklens.optics.analysis.spots import centroid
from tasklens.optics.rays import Rays, passing
from tasklens.optics.view import View

_FREQUENCIES = (0.125, 0.25)  # a quarter and a half of the Nyquist frequency, for the contrast [cycles per pixel]
_TAPS = 3  # of the best linear filter on each side of a pixel
_ROUNDING = 1 / (12 * 255**2)  # variance of the rounding of 8-bit values


@dataclass(frozen=True)
class ImageError(CaptureCriterion):
    """Mean squared error between capture and sharp image (paper, Eq. 2), or its natural logarithm.

    The logarithm is the PSNR up to a factor. It weights images of low contrast and nearly sharp fields like all others.
    """

    logarithm: bool

    def losses(self, captures: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        """Compute the error (N,)."""
        error = (captures - images).square().mean((-3, -2, -1))
        return error.clamp(min=1e-12).log() if self.logarithm else error


class Correlation(CaptureCriterion):
    """Lost correlation 1 - r of capture c and sharp image s.

    r = <c - mean c, s - mean s> / (|c - mean c| |s - mean s|)

    Means are over the pixels of each colour, the product and norms over all values. The loss does not change if the
    capture is scaled or brightened, for example by haze.
    """

    def losses(self, captures: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        """Compute the loss (N,)."""
        c, s = ((v - v.mean((-2, -1), keepdim=True)).flatten(1) for v in (captures, images))
        return 1 - (c * s).sum(1) / (c.norm(dim=1) * s.norm(dim=1)).clamp(min=1e-12)


class WienerError(CaptureCriterion):
    """Variance of a sharp image s that the best linear filter does not recover from its capture c, as a fraction.

    e = 1 - sum b.(A + n I)^-1 b / sum |s|^2,  A_tu = <c_t, c_u>,  b_t = <c_t, s>

    c_t is the capture, shifted cyclically by t in a window of 7 x 7 pixels. Sums are over the colours, whose means are
    subtracted. Each colour of each capture has its own filter, fitted with the sharp image known: a bound for filters
    of sRGB values of this size, which noise and wider blur limit. n is the number of pixels times the variance of
    rounding to 8 bits, so that A is never singular.
    """

    def losses(self, captures: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        """Compute the loss (N,)."""
        c, s = ((v - v.mean((-2, -1), keepdim=True)).double() for v in (captures, images))
        spectrum = torch.fft.rfft2(c)
        of_capture = torch.fft.irfft2(torch.view_as_real(spectrum).square().sum(-1), s=c.shape[-2:])
        with_image = torch.fft.irfft2(spectrum.conj() * torch.fft.rfft2(s), s=c.shape[-2:])
        taps = torch.cartesian_prod(*2 * [torch.arange(-_TAPS, _TAPS + 1)])
        y, x = (taps[:, None] - taps).unbind(-1)
        a, b = of_capture[..., y, x], with_image[..., taps[:, 0], taps[:, 1]]
        a.diagonal(dim1=-2, dim2=-1).add_(s[0, 0].numel() * _ROUNDING)
        recovered = (b * torch.linalg.solve(a, b)).sum((-2, -1))
        return (1 - recovered / s.square().sum((1, 2, 3)).clamp(min=1e-12)).to(captures)


class SpotRadius(FieldCriterion):
    """RMS spot radius sqrt(mean(r^2)) about the polychromatic centroid [mm] of all rays that are not vignetted.

    A lost ray counts as 1 mm away, and a field that is vignetted completely has 1 mm.
    """

    scales_with_stop = True
    by_psf = False

    def of_fields(self, rays: Rays, grid: Tensor | None, view: View) -> Tensor:
        """Compute the radius (F,) of each field."""
        middle = centroid(rays)
        squared = (rays.x - middle[:, 0, None, None]) ** 2 + (rays.y - middle[:, 1, None, None]) ** 2
        counted = ~rays.vignetted
        mean = (torch.where(rays.valid, squared, 1.0) * counted).sum((1, 2)) / passing(rays)
        return torch.where(counted.flatten(1).any(1), mean, 1.0).sqrt()


class Contrast(FieldCriterion):
    """Contrast lost at a quarter and a half of the Nyquist frequency: 1 - Re(OTF), without images.

    OTF(f) = sum_p PSF(p) exp(-2 pi i f.p), with p from the centre of the window. It is the mean over colours, over both
    frequencies, and over gratings across the field (tangential) and along it. The real part penalises a shifted or
    reversed contrast; the modulus, the MTF, does not. Descents on the MTF led to lenses of high MTF whose captures
    classifiers read worse (docs/notes/baselines.md).
    """

    def of_fields(self, rays: Rays, grid: Tensor | None, view: View) -> Tensor:
        """Compute the loss (F,) of PSFs."""
        assert grid is not None  # by_psf
        return self.losses(grid, view.directions)

    def losses(self, grid: Tensor, directions: Tensor) -> Tensor:
        """Compute the loss (F,) of PSFs (F, W, K, K); light outside the window has no contrast.

        Args:
            directions: (F, 2) unit vectors of the tangential direction, as `View.directions`.
        """
        pixel = torch.arange(grid.shape[-1], dtype=grid.dtype) - grid.shape[-1] // 2
        ex, ey = directions.to(grid).unbind(-1)
        contrasts = []
        for dx, dy in ((ex, ey), (-ey, ex)):
            position = dx[:, None, None] * pixel + dy[:, None, None] * pixel[:, None]
            for frequency in _FREQUENCIES:
                wave = torch.cos(2 * math.pi * frequency * position)
                contrasts.append((grid * wave[:, None]).sum((-2, -1)).mean(-1))
        return 1 - torch.stack(contrasts).mean(0)


CRITERIA: dict[str, Criterion] = {
    "spot": SpotRadius(),
    "image_error": ImageError(logarithm=False),
    "log_image_error": ImageError(logarithm=True),
    "correlation": Correlation(),
    "wiener_error": WienerError(),
    "contrast": Contrast(),
}
