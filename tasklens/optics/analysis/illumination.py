"""Relative illumination, with vignetting."""

from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import gauss_quadrature
from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.view import View


def relative_illumination(lens: Lens, view: View, rings: int = 24, arms: int = 64) -> Tensor:
    """Compute the illuminance (F,) of fields relative to the axis, at the middle wavelength; zero for a lost field.

    Decentres and tilts are ignored.

    E / E0 = A / A0,  A = integral over the pupil of |d(l, m) / d(px, py)| over the valid rays

    A is the area of the bundle in the plane of the direction cosines behind the lens, without vignetted rays. It does
    not depend on the parametrisation of the pupil. Pupil points are points of the real stop, at which rays are aimed,
    so the result includes an entrance pupil that grows with the field.

    Source: Rimmer 1986, Proc. SPIE 655, 99.

    Args:
        rings, arms: pupil points on the half pupil. With the defaults, the error is at rounding for a smooth bundle,
            and a few 1e-3 for a vignetted one.
    """
    lens, turned = replace(lens, pose=None), view.in_reference().in_meridian()
    with_axis = replace(turned, fields=torch.cat([torch.zeros_like(turned.fields[:1]), turned.fields]))
    points, weights = gauss_quadrature(rings, arms)  # half pupil x > 0: fields on y are symmetric in x

    def cosines(pupil: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor]:
        rays = trace_fields(lens, with_axis, pupil)
        return (rays.l[:, 0], rays.m[:, 0]), rays.valid[:, 0]

    directions = torch.eye(2, dtype=points.dtype).repeat_interleave(len(points), 0)  # along px, then along py
    _, (l, m), arrives = torch.func.jvp(cosines, (points.repeat(2, 1),), (directions,), has_aux=True)  # type: ignore[misc]
    (lx, ly), (mx, my) = (slope.unflatten(-1, (2, -1)).unbind(-2) for slope in (l, m))
    arrives = arrives[:, : len(points)]
    area = torch.where(arrives, weights * (lx * my - ly * mx).abs(), 0.0).sum(-1)
    return torch.where(area[0] > 0, area[1:] / torch.where(area[0] > 0, area[0], 1.0), 0.0)
