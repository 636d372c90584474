"""Geometric MTF (without diffraction), and diffraction limits."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from tasklens.optics.rays import Rays, passing

_HALF_NYQUIST = 0.25  # [cycles per pixel]


def geometric_mtf(rays: Rays, directions: Tensor, frequencies: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Compute the polychromatic geometric MTF, tangential and sagittal.

    MTF(f) = |(1 / N) sum_i exp(-2 pi i f s_i)|  over the N rays of all wavelengths that pass the clear apertures

    s is the coordinate of a ray along the field (tangential: the lines of the grating lie across the field) or across
    it (sagittal). Other lost rays add nothing to the sum but count in N: the MTF then begins below one, and losing
    rays does not increase contrast. It includes neither diffraction nor pixels, and is not meaningful near
    `diffraction_cutoff` and beyond.

    Args:
        rays: rays on the image plane, (F, W, N).
        directions: (F, 2) unit vectors of the tangential direction, as `View.directions`.
        frequencies: K frequencies [cycles/mm].

    Returns:
        (F, K) tangential and (F, K) sagittal MTF, from 0 to 1.

    Source: Smith, Modern Optical Engineering (2008): the transform of the line spread function.
    """
    ex, ey = (directions[:, k, None, None, None] for k in (0, 1))
    x, y = (torch.where(rays.valid, v, 0.0)[..., None] for v in (rays.x, rays.y))
    scale = 2 * math.pi * torch.as_tensor(frequencies, dtype=rays.x.dtype)

    def modulus(coordinate: Tensor) -> Tensor:
        phase = scale * coordinate
        parts = (torch.where(rays.valid[..., None], f(phase), 0.0).sum((1, 2)) for f in (torch.cos, torch.sin))
        return torch.hypot(*parts) / passing(rays)[:, None]

    return modulus(ex * x + ey * y), modulus(ex * y - ey * x)


def limited_mtf(
    rays: Rays, directions: Tensor, frequencies: Sequence[float], wavelength: float
) -> tuple[Tensor, Tensor]:
    """Compute the geometric MTF times that of a perfect lens, tangential and sagittal: an estimate with diffraction.

    The perfect lens has a round pupil and, in each field and direction, the cut-off of these rays: the extent of their
    direction cosines over the wavelength. For arguments and shapes see `geometric_mtf`; `wavelength` in um.

    Source: the geometric MTF of OpticStudio has this product as an option.
    """
    ex, ey = (directions[:, k, None, None] for k in (0, 1))
    limited = []
    for geometric, cosine in zip(
        geometric_mtf(rays, directions, frequencies),
        (ex * rays.l + ey * rays.m, ex * rays.m - ey * rays.l),
        strict=True,
    ):
        highest, lowest = (torch.where(rays.valid, sign * cosine, -torch.inf).amax((1, 2)) for sign in (1, -1))
        cutoff = 1e3 / wavelength * (highest + lowest).clamp(min=1e-9)[:, None]
        limited.append(geometric * perfect_mtf(torch.as_tensor(frequencies, dtype=rays.x.dtype), cutoff))
    return limited[0], limited[1]


def mean_mtf(psf: Tensor) -> Tensor:
    """Compute the mean over fields, colours, directions and frequencies of the MTF of PSFs (F, W, K, K).

    Frequencies go up to half of Nyquist's, a quarter of a cycle per pixel. Light outside the window counts as light
    without contrast.
    """
    side = 2 * psf.shape[-1]
    frequency = torch.hypot(torch.fft.fftfreq(side)[:, None], torch.fft.fftfreq(side))
    in_band = (frequency > 0) & (frequency <= _HALF_NYQUIST)
    return torch.fft.fft2(psf, (side, side)).abs()[..., in_band].mean()


def perfect_mtf(frequency: Tensor, cutoff: Tensor | float) -> Tensor:
    """Compute the MTF of a perfect lens with a round pupil at a frequency [cycles/mm], of any shape.

    MTF = (2 / pi) (acos(v) - v sqrt(1 - v^2)), v = frequency / cutoff, and zero beyond the cut-off.

    Source: Smith, Modern Optical Engineering (2008).
    """
    share = (frequency / cutoff).clamp(max=1)
    return 2 / torch.pi * (torch.acos(share) - share * torch.sqrt(1 - share**2))


def diffraction_cutoff(f_number: float, wavelength: float) -> float:
    """Compute the cut-off frequency 1 / (lambda N) [cycles/mm] of the diffraction-limited MTF; wavelength in um."""
    return 1e3 / (wavelength * abs(f_number))


def airy_radius(f_number: float, wavelength: float) -> float:
    """Compute the radius 1.22 lambda N [um] of the first dark Airy ring; wavelength in um."""
    return 1.21966989 * wavelength * abs(f_number)
