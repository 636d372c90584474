"""Even aspheres: sag and slope, defined for every radius."""

import torch
from torch import Tensor

EDGE = 1e-6  # smallest argument of the square root that still counts as inside the conic


def sag(u: Tensor, curvature: Tensor | float, conic: Tensor | float, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the sag of an even asphere, its derivative, and whether the point is inside the conic.

    s(u) = c u / (1 + sqrt(1 - (1 + k) c^2 u)) + sum_j alpha_2j u^j,  u = r^2

    Beyond the edge of the conic the root is held at its edge value, so that value and gradient stay finite.

    Args:
        u: squared radius [mm^2], any shape.
        curvature: c [1/mm], a number or broadcastable to u.
        conic: k, a number or broadcastable to u.
        alpha: (..., M) coefficients alpha_2 .. alpha_2M [mm^(1 - 2j)]; the leading shape is broadcastable to u.

    Returns:
        sag [mm], d sag / d u [1/mm], and a mask that is true inside the conic; each of the broadcast shape.
    """
    argument = 1 - (1 + conic) * curvature**2 * u
    inside = argument > EDGE
    root = torch.sqrt(torch.where(inside, argument, EDGE))
    value = curvature * u / (1 + root)
    slope = 0.5 * curvature / root
    orders = alpha.unbind(-1)
    if orders:
        # Horner's rule for sum_j alpha_2j u^(j - 1) and for its derivative, together
        polynomial = orders[-1]
        derivative = torch.zeros_like(polynomial)
        for coefficient in reversed(orders[:-1]):
            derivative = derivative * u + polynomial
            polynomial = polynomial * u + coefficient
        value = value + polynomial * u
        slope = slope + polynomial + derivative * u
    return value, slope, inside


def bounds(u: Tensor, curvature: Tensor | float, conic: Tensor | float, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Compute bounds of |ds/du| [1/mm] and |d^2 s/du^2| [1/mm^3] up to u = r^2; arguments as in `sag`.

    |c| w / 2 + sum_j j |alpha_2j| u^(j - 1),  |(1 + k) c^3| w^3 / 4 + sum_j j (j - 1) |alpha_2j| u^(j - 2)

    w is the largest 1 / sqrt(1 - (1 + k) c^2 u): at u for 1 + k > 0, otherwise 1.
    """
    bending = (1 + conic) * curvature**2
    w = torch.rsqrt((1 - bending * u).clamp(EDGE, 1.0))
    slope, second = 0.5 * abs(curvature * w), 0.25 * abs(bending * curvature * w**3)
    for j, coefficient in enumerate(alpha.abs().unbind(-1), 1):
        slope = slope + j * coefficient * u ** (j - 1)
        if j > 1:
            second = second + j * (j - 1) * coefficient * u ** (j - 2)
    return slope, second


def radial_slope(radius: Tensor, curvature: Tensor, conic: Tensor, alpha: Tensor) -> Tensor:
    """Compute the slope d sag / d r = 2 r d sag / d u at `radius` [mm]; shapes as in `sag`."""
    return 2 * radius * sag(radius**2, curvature, conic, alpha)[1]
