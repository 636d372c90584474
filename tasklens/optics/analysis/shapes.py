"""Shapes of surfaces: steepest angle, departure from a sphere, inflections."""

from dataclasses import dataclass

import torch

from tasklens.optics.aspheres import radial_slope, sag
from tasklens.optics.lens import Lens

_HEIGHTS = torch.linspace(0, 1, 401, dtype=torch.float64)  # fractions of the semi-diameter


@dataclass(frozen=True)
class Shape:
    """Shape of a surface within its clear aperture.

    Attributes:
        surface: index in the lens.
        semi_diameter_mm: radius of the clear aperture [mm].
        steepest_deg: largest angle between the surface and its vertex plane [degrees].
        departure_um: largest distance along z from the sphere through vertex and rim [um].
        inflections: number of heights at which the second derivative of the sag changes its sign.
    """

    surface: int
    semi_diameter_mm: float
    steepest_deg: float
    departure_um: float
    inflections: int


def shapes(lens: Lens) -> list[Shape]:
    """Compute the shape of every refracting surface; the lens must have finite clear apertures."""
    return [_shape(lens.detached(), i) for i in lens.refracting_surfaces]


def _shape(lens: Lens, i: int) -> Shape:
    semi_diameter = float(lens.semi_diameter[i])
    height = semi_diameter * _HEIGHTS
    surface = lens.curvature[i], lens.conic[i], lens.alpha[i]
    z, slope = sag(height**2, *surface)[0], radial_slope(height, *surface)
    rim = z[-1]
    # z^2 - 2 z / c + r^2 = 0 on a sphere; this c is of the sphere through the rim
    curvature = 2 * rim / (rim**2 + semi_diameter**2)
    sphere = sag(height**2, curvature, torch.zeros_like(curvature), lens.alpha[i, :0])[0]
    bending = torch.sign(slope.diff())
    bending = bending[bending != 0]
    return Shape(
        surface=i,
        semi_diameter_mm=semi_diameter,
        steepest_deg=float(torch.rad2deg(torch.atan(slope.abs().max()))),
        departure_um=1e3 * float((z - sphere).abs().max()),
        inflections=int((bending[1:] != bending[:-1]).sum()),
    )
