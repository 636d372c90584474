"""Relative illumination, with vignetting."""

from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import gauss_quadrature, launch_fields
from tasklens.optics.lens import Lens
from tasklens.optics.tracing.trace import trace
from tasklens.optics.view import View

_SPREAD = 1.5  # largest ratio of the image area of a ray and its median


def relative_illumination(lens: Lens, view: View, rings: int = 24, arms: int = 64) -> Tensor:
    """Compute the illuminance (F,) of fields relative to the axis, at the middle wavelength; zero for a lost field.

    Rays that leave a point of an evenly bright object with the etendue g illuminate an area s of the image:

        E / E0 = B / B0,  B = integral over the pupil of g / s,
        g = |d(x, y, l, m at launch) / d(field, pupil)|,  s = |d(x, y in the image) / d(field)|,  for arriving rays

    Rays are aimed at the real stop, so that an entrance pupil that grows with the field counts, as does distortion.
    B is the area of the bundle in the plane of the direction cosines behind the lens (Rimmer 1986, Proc. SPIE 655, 99),
    cos^4 for a thin lens. This holds for a sharp image. In a blurred one the bundle of an object point may fold over
    itself, where s = 0, and a few rays fly far away; so s is limited to a factor of 1.5 of its median. For task-driven
    doublets, this is the density of counted rays within 1 %, and within 6 % in the corner. Decentres and tilts are
    ignored.

    Args:
        rings, arms: pupil points on the half pupil. With the defaults, the error is at rounding for a sharp bundle,
            and a few 1e-3 for a vignetted one.
    """
    lens, turned = replace(lens, pose=None), view.in_reference().in_meridian()
    with_axis = replace(turned, fields=torch.cat([torch.zeros_like(turned.fields[:1]), turned.fields]))
    points, weights = gauss_quadrature(rings, arms)  # half pupil x > 0: fields on y are symmetric in x
    indices = lens.refractive_indices(with_axis.wavelengths_um)

    def launch_points(pupil: Tensor) -> Tensor:
        rays = launch_fields(lens, with_axis, pupil)
        return torch.stack([rays.x, rays.y, rays.l, rays.m], -1)[:, 0]

    def trace_points(fields: Tensor) -> tuple[Tensor, Tensor]:
        start = launch_fields(lens, replace(with_axis, fields=fields), points)
        end = trace(lens, start, indices)
        return torch.stack([start.x, start.y, start.l, start.m, end.x, end.y], -1)[:, 0], end.valid[:, 0]

    fields, directions = with_axis.fields, torch.eye(2, dtype=points.dtype)
    _, along_pupil = torch.func.jvp(  # type: ignore[misc]
        launch_points, (points.repeat(2, 1),), (directions.repeat_interleave(len(points), 0),)
    )
    _, along_fields, arrives = torch.func.jvp(  # type: ignore[misc]
        trace_points, (fields.repeat(2, 1),), (directions.repeat_interleave(len(fields), 0),), has_aux=True
    )
    px, py = along_pupil.unflatten(1, (2, -1)).unbind(1)
    fx, fy = along_fields.unflatten(0, (2, -1)).unbind(0)
    etendue = torch.linalg.det(torch.stack([fx[..., :4], fy[..., :4], px, py], -1)).abs()
    light = torch.where(arrives[: len(fields)], weights * etendue, 0.0)
    area = (fx[..., 4] * fy[..., 5] - fx[..., 5] * fy[..., 4]).abs()
    median = _median(area, light)
    area = area.clamp(median / _SPREAD, median * _SPREAD)
    density = torch.where((light > 0) & (area > 0), light / torch.where(area > 0, area, 1.0), 0.0).sum(-1)
    return torch.where(density[0] > 0, density[1:] / torch.where(density[0] > 0, density[0], 1.0), 0.0)


def _median(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted medians (F, 1) of values (F, N)."""
    ordered, order = values.sort(-1)
    below = weights.gather(-1, order).cumsum(-1)
    middle = torch.searchsorted(below, below[:, -1:] / 2)
    return ordered.gather(-1, middle)
