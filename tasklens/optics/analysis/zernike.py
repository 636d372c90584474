"""Zernike polynomials in Noll's order, coefficients of a wavefront, and its RMS.

Z_j with azimuthal order m = 0: sqrt(n + 1) R_n^0(r); m > 0: sqrt(2 (n + 1)) R_n^m(r) cos(m theta) for even j and
sin(m theta) for odd j. theta is from +x. Over the unit disc the mean of Z_j Z_k is 1 for j = k, else 0, so that a
coefficient is the RMS of its term. Z1 piston, Z2 and Z3 tilt along x and y, Z4 defocus, Z5 and Z6 astigmatism, Z7 and
Z8 coma, Z9 and Z10 trefoil, Z11 spherical aberration.

Source: Noll 1976, J. Opt. Soc. Am. 66, 207.
"""

import math

import torch
from torch import Tensor

_WEAKEST = 1e-8  # smallest ratio of the least to the largest eigenvalue of normal equations that can be solved


def noll_orders(index: int) -> tuple[int, int]:
    """Return the orders (n, m) of Z_j, j = `index` from 1; m is negative for a sine."""
    if index < 1:
        raise ValueError(f"index: Noll's order starts at 1, got {index}")
    n = (math.isqrt(8 * index - 7) - 1) // 2
    place = index - n * (n + 1) // 2 - 1  # 0 .. n among the terms of order n, |m| = n % 2, .. n
    m = place + (place + n) % 2
    return n, -m if index % 2 and m else m


def zernike(pupil: Tensor, count: int) -> Tensor:
    """Compute Z_1 .. Z_count, (N, count), at the points `pupil` (N, 2) of the unit disc."""
    x, y = pupil.unbind(-1)
    square, powers = x * x + y * y, [torch.complex(torch.ones_like(x), torch.zeros_like(x))]
    terms = []
    for n, m in map(noll_orders, range(1, count + 1)):
        while len(powers) <= abs(m):
            powers.append(powers[-1] * torch.complex(x, y))  # (r exp(i theta))^m
        radial = torch.zeros_like(x)  # R_n^m / r^m by Horner's rule in r^2
        for coefficient in _radial(n, abs(m)):
            radial = radial * square + coefficient
        angular = powers[-m].imag if m < 0 else powers[m].real
        terms.append(math.sqrt((n + 1) * (2 if m else 1)) * radial * angular)
    return torch.stack(terms, -1)


def _radial(n: int, m: int) -> list[int]:
    """Return the coefficients (-1)^k (n - k)! / (k! ((n + m) / 2 - k)! ((n - m) / 2 - k)!) of r^(n - 2k) in R_n^m."""
    f = math.factorial
    return [(-1) ** k * f(n - k) // (f(k) * f((n + m) // 2 - k) * f((n - m) // 2 - k)) for k in range((n - m) // 2 + 1)]


def zernike_coefficients(opd: Tensor, pupil: Tensor, count: int) -> Tensor:
    """Fit the coefficients (..., count) of Z_1 .. Z_count by least squares over the valid points, in the unit of `opd`.

    Over a vignetted bundle the terms are not orthogonal, so a coefficient depends on `count`. Differentiable in `opd`.

    Args:
        opd: (..., N) optical path differences, as from `wavefront`; NaN where a ray is lost.
        pupil: (N, 2) points of the unit disc, of equal weight.
        count: number of coefficients.

    Returns:
        The coefficients; NaN if the valid points do not determine them.
    """
    terms, valid = zernike(pupil.to(opd.dtype), count), ~opd.isnan()
    weight = valid.to(opd.dtype)
    normal = torch.einsum("...p,pj,pk->...jk", weight, terms, terms)
    strength = torch.linalg.eigvalsh(normal)
    determined = strength[..., :1] > _WEAKEST * strength[..., -1:]
    normal = torch.where(determined[..., None], normal, torch.eye(count, dtype=opd.dtype))
    right = torch.where(valid, opd, 0.0) @ terms
    return torch.where(determined, torch.linalg.solve(normal, right[..., None])[..., 0], torch.nan)


def rms_wavefront_error(opd: Tensor, pupil: Tensor, removed: int = 3) -> Tensor:
    """Compute the RMS (...) over the valid points after removing Z_1 .. Z_removed, in the unit of `opd`.

    removed = 0: relative to the chief ray's path; 1: without piston, the standard deviation; 3: also without tilt,
    relative to the best-fitting image point; 4: also refocused. Shapes and NaN as in `zernike_coefficients`.
    """
    valid = ~opd.isnan()
    rest = torch.where(valid, opd, 0.0)
    if removed:
        coefficients = zernike_coefficients(opd, pupil, removed)
        rest = rest - coefficients @ zernike(pupil.to(opd.dtype), removed).mT
    squared = torch.where(valid, rest, 0.0).square().sum(-1)
    count = valid.sum(-1)
    rms = torch.where(count > 0, torch.sqrt(squared / count.clamp(min=1)), torch.nan)
    return torch.where(coefficients.isnan().any(-1), torch.nan, rms) if removed else rms
