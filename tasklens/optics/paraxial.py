"""First-order data of a lens, from the paraxial (y, n u) trace.

The power of a surface is (n' - n) (c + 2 alpha_2): the r^2 term bends light like a curvature.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tasklens.optics.lens import Lens


@dataclass(frozen=True)
class Paraxial:
    """First-order data at one wavelength [mm], as 0-dim tensors.

    Attributes:
        power: 1 / efl [1/mm], finite and differentiable for an afocal lens too.
        efl: effective focal length.
        bfl: distance from the last vertex to the paraxial focus.
        entrance_pupil_z: position of the entrance pupil, from the first vertex.
        entrance_pupil_radius: its radius.
    """

    power: Tensor
    efl: Tensor
    bfl: Tensor
    entrance_pupil_z: Tensor
    entrance_pupil_radius: Tensor


def _propagate(lens: Lens, indices: Tensor, height: Tensor, reduced_angle: Tensor, surfaces: range):
    """Height y and reduced angle n u of a paraxial ray behind the last of `surfaces`."""
    for i in surfaces:
        if i > surfaces.start:
            height = height + reduced_angle / indices[i] * lens.thickness[i - 1]
        strength = lens.curvature[i] + (2 * lens.alpha[i, 0] if lens.alpha.shape[1] else 0)
        reduced_angle = reduced_angle - height * (indices[i + 1] - indices[i]) * strength
    return height, reduced_angle


def paraxial(lens: Lens, wavelength: float) -> Paraxial:
    """First-order data of `lens` at `wavelength` [um]; an afocal lens has infinite focal lengths."""
    n = lens.refractive_indices((wavelength,))[:, 0]
    one, zero = torch.ones((), dtype=lens.dtype), torch.zeros((), dtype=lens.dtype)
    height, angle = _propagate(lens, n, one, zero, range(len(lens.media)))
    efl, bfl = -1 / angle, -height / (angle / n[-1])
    # Two rays through the surfaces before the stop form the matrix (A B; C D) from the first vertex to the stop.
    front = range(lens.stop + 1)
    a, _ = _propagate(lens, n, one, zero, front)
    b, _ = _propagate(lens, n, zero, one, front)
    # The ray that meets the stop on its axis comes from height y0, angle u0 with a y0 + b u0 = 0: it crosses z = b / a.
    return Paraxial(-angle, efl, bfl, b / a, lens.semi_diameter[lens.stop] / a.abs())
