"""Relative illumination, with vignetting."""

from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import gauss_quadrature, launch_fields
from tasklens.optics.lens import Lens
from tasklens.optics.tracing.trace import trace
from tasklens.optics.view import View

_SPREAD = 1.5  # largest ratio of the image area of a ray and its median
_STEP = 1e-5  # of central differences, in units of focal length and pupil radius: errors below 1e-9
_DIRECTIONS = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64)


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
        rings, arms: pupil points on the half pupil. With the defaults, the error is below 1e-9 for a sharp bundle, and
            a few 1e-3 for a vignetted one.
    """
    dtype, turned = lens.dtype, view.in_reference().in_meridian()
    lens = replace(lens, pose=None).double()  # for differences
    with_axis = replace(turned, fields=torch.cat([torch.zeros_like(turned.fields[:1]), turned.fields]))
    points, weights = gauss_quadrature(rings, arms)  # half pupil x > 0: fields on y are symmetric in x
    indices = lens.refractive_indices(with_axis.wavelengths_um)

    def along(values: Tensor) -> tuple[Tensor, Tensor]:
        """Return the changes (F, N, M) of values (4, F, N, M) at +x, -x, +y, -y."""
        return (values[0] - values[1]) / (2 * _STEP), (values[2] - values[3]) / (2 * _STEP)

    fields, steps = with_axis.fields, _STEP * _DIRECTIONS
    shifted = torch.cat([fields, *(fields + view.efl * step for step in steps)])
    start = launch_fields(lens, replace(with_axis, fields=shifted), points)
    end = trace(lens, start, indices)
    arrives = end.valid[:, 0].unflatten(0, (5, -1)).all(0)
    near = torch.stack([start.x, start.y, start.l, start.m, end.x, end.y], -1)[len(fields) :, 0]
    fx, fy = along(near.unflatten(0, (4, -1)))
    rays = launch_fields(lens, with_axis, torch.cat([points + step for step in steps]))
    arrives &= rays.valid[:, 0].unflatten(1, (4, -1)).all(1)
    near = torch.stack([rays.x, rays.y, rays.l, rays.m], -1)[:, 0]
    px, py = along(near.unflatten(1, (4, -1)).transpose(0, 1))
    etendue = torch.linalg.det(torch.stack([fx[..., :4], fy[..., :4], px, py], -1)).abs()
    light = torch.where(arrives, weights * etendue, 0.0)
    area = (fx[..., 4] * fy[..., 5] - fx[..., 5] * fy[..., 4]).abs()
    median = _median(area, light)
    area = area.clamp(median / _SPREAD, median * _SPREAD)
    density = torch.where((light > 0) & (area > 0), light / torch.where(area > 0, area, 1.0), 0.0).sum(-1)
    relative = torch.where(density[0] > 0, density[1:] / torch.where(density[0] > 0, density[0], 1.0), 0.0)
    return relative.to(dtype)


def _median(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted medians (F, 1) of values (F, N)."""
    ordered, order = values.sort(-1)
    below = weights.gather(-1, order).cumsum(-1)
    middle = torch.searchsorted(below, below[:, -1:] / 2)
    return ordered.gather(-1, middle)
