"""First-order data of a lens, from the paraxial (y, n u) trace.

The power of a surface is (n' - n) (c + 2 alpha_2), since the r^2 term acts like a curvature.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tasklens.optics.lens import Lens
from tasklens.runtime.errors import InputError


@dataclass(frozen=True)
class Paraxial:
    """First-order data at one wavelength [mm], as 0-dim tensors.

    Attributes:
        power: 1 / efl [1/mm], also finite and differentiable for an afocal lens.
        efl: effective focal length.
        bfl: distance from the last vertex to the paraxial focus.
        entrance_pupil_z: position of the entrance pupil, from the first vertex.
        entrance_pupil_radius: radius of the entrance pupil.
        exit_pupil_z: position of the exit pupil, from the last vertex; infinite for an image-space telecentric lens.
        exit_pupil_radius: radius of the exit pupil.
        pupil_vergence: 1 / distance from the exit pupil to the image plane [1/mm], positive for a pupil in front of the
            image; also finite and differentiable for a telecentric lens.
    """

    power: Tensor
    efl: Tensor
    bfl: Tensor
    entrance_pupil_z: Tensor
    entrance_pupil_radius: Tensor
    exit_pupil_z: Tensor
    exit_pupil_radius: Tensor
    pupil_vergence: Tensor

    @property
    def is_positive(self) -> bool:
        """True if the focal length is positive and finite."""
        return 0 < float(self.efl.detach()) < math.inf

    @property
    def f_number(self) -> Tensor:
        """EFL / diameter of the entrance pupil."""
        return self.efl / (2 * self.entrance_pupil_radius)


def vertex_curvature(lens: Lens) -> Tensor:
    """Return (S,) curvatures at the vertices, c + 2 alpha_2 [1/mm]."""
    return lens.curvature + (2 * lens.alpha[:, 0] if lens.alpha.shape[1] else 0)


def powers_and_thicknesses(lens: Lens, indices: Tensor) -> tuple[Tensor, Tensor]:
    """Compute powers and reduced thicknesses, with refractive indices (S + 1,) before it and behind each surface.

    Returns:
        (S,) powers of the surfaces, (n' - n) (c + 2 alpha_2) [1/mm]; (S,) reduced thicknesses behind them, t / n
        [mm].
    """
    return (indices[1:] - indices[:-1]) * vertex_curvature(lens), lens.thickness / indices[1:]


def paraxial_ray(
    power: Tensor, reduced_thickness: Tensor, height: Tensor, reduced_angle: Tensor
) -> tuple[Tensor, Tensor]:
    """Trace paraxial rays through all surfaces: n' u' = n u - y phi, y_next = y + n' u' t / n'.

    Args:
        power, reduced_thickness: (S, ...) powers phi of the surfaces, and reduced thicknesses t / n behind them; the
            last one is not used. They may be of several lenses if they broadcast with the rays.
        height: y [mm] at the first vertex, any shape.
        reduced_angle: n u in front of the lens, of the same shape.

    Returns:
        (S, ...) heights y at the surfaces [mm], (S + 1, ...) reduced angles n u before the lens and behind each.
    """
    heights, angles = [], [reduced_angle]
    for i in range(len(power)):
        if i > 0:
            height = height + angles[-1] * reduced_thickness[i - 1]
        heights.append(height)
        angles.append(angles[-1] - height * power[i])
    return torch.stack(heights), torch.stack(angles)


def paraxial(lens: Lens, wavelength: float) -> Paraxial:
    """Compute the first-order data of a lens at `wavelength` [um]; an afocal lens has infinite focal lengths."""
    n = lens.refractive_indices((wavelength,))[:, 0]
    # Two rays, from (y, n u) = (1, 0) and (0, 1), form the matrix (A B; C D) from the first vertex to every other.
    unit = torch.eye(2, dtype=lens.dtype)
    heights, angles = paraxial_ray(*powers_and_thicknesses(lens, n), *unit)
    height, angle = heights[-1, 0], angles[-1, 0]
    a, b = heights[lens.stop]
    # A ray through the centre of the stop has a y0 + b u0 = 0 and crosses the axis at z = -y0 / u0 = b / a.
    # Behind the lens this ray, scaled to (y0, n u0) = (b, -a) so that n u = -1 at the stop, crosses the axis at -y / u.
    chief_height, chief_angle = (b * v[-1, 0] - a * v[-1, 1] for v in (heights, angles))
    chief_slope = chief_angle / n[-1]
    radius = lens.semi_diameter[lens.stop]
    return Paraxial(
        power=-angle,
        efl=-1 / angle,
        bfl=-height / (angle / n[-1]),
        entrance_pupil_z=b / a,
        entrance_pupil_radius=radius / a.abs(),
        exit_pupil_z=-chief_height / chief_slope,
        exit_pupil_radius=radius / chief_angle.abs(),
        pupil_vergence=chief_slope / (chief_height + chief_slope * lens.thickness[-1]),
    )


def check_focal_length(lens: Lens, wavelength: float, purpose: str) -> None:
    """Raise InputError if the focal length at `wavelength` [um] is not positive; `purpose` is what needs it."""
    first_order = paraxial(lens.detached(), wavelength)
    if not first_order.is_positive:
        raise InputError(
            f"focal length {float(first_order.efl):.4g} mm: {purpose} a positive one; relays, negative and afocal "
            "lenses are only shown and traced"
        )
