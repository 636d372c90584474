"""The wavefront at the exit pupil: optical path differences from a reference sphere, and their RMS.

Conventions:

- The exit pupil is paraxial, at the middle wavelength: the point on the axis at which the image of the stop lies.
- The reference sphere has its centre on the image plane, by default at the image point of the chief ray of each
  wavelength (as in Optiland), and passes through the centre of the exit pupil. If the exit pupil is behind the image
  plane, so is the sphere; if it is at infinity, the sphere is a plane.
- W is the optical path of the chief ray from the object to the sphere minus that of the ray: it is zero for the chief
  ray and positive if the wavefront is ahead of the sphere, as in `seidel_sums`.
"""

import torch
from torch import Tensor

from tasklens.optics.analysis.object_points import object_path
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import launch_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.tracing.trace import trace
from tasklens.optics.view import View

_CENTRE = torch.zeros(1, 2, dtype=torch.float64)  # pupil point of the chief ray
_WEAKEST = 1e-8  # smallest ratio of the least to the largest eigenvalue of normal equations that can be solved


def path_differences(lens: Lens, view: View, pupil: Tensor, centre: Tensor | None = None) -> Tensor:
    """Compute the optical path differences from the reference sphere, differentiable in the lens.

    W = (L_chief - L) / wavelength,  L = n s + path - n' t

    s is the path of the ray from its object point to its launch point (`object_path`). `path` leads from there to the
    point d on the image plane, relative to the centre. t is the distance back along the direction D to the sphere of
    radius R = 1 / c:

    t - R = d.D + c q / (1 + sqrt(1 + c^2 q)),  q = (d.D)^2 - d.d

    Args:
        lens: its clear apertures and its stop vignette.
        view: fields and wavelengths.
        pupil: (N, 2) points of the stop, the unit disc.
        centre: (F, 2) or (F, W, 2) centres of the spheres [mm]; by default the chief ray's image point at each
            wavelength. With `chief_points`, at the middle wavelength, lateral colour is a tilt.

    Returns:
        (F, W, N) optical path difference W of each ray [waves of its wavelength]; NaN for lost rays, for all rays of a
        field and wavelength whose chief ray is lost, for rays that miss the sphere, and for an exit pupil on the image
        plane.

    Source: Welford, Aberrations of Optical Systems (1986), chapter 7.
    """
    start = launch_fields(lens, view, torch.cat([_CENTRE, pupil]))
    indices = lens.refractive_indices(view.wavelengths_um)
    rays = trace(lens, start, indices)
    if centre is None:
        centre = torch.stack([rays.x[..., 0], rays.y[..., 0]], -1)
    elif centre.dim() == 2:
        centre = centre[:, None].expand(-1, len(view.wavelengths_um), -1)
    vergence = paraxial(lens, view.reference_um).pupil_vergence
    curvature = vergence / torch.sqrt(1 + vergence**2 * centre.square().sum(-1))
    distance, meets = _to_sphere(rays, centre[:, :, None], curvature[..., None])
    phase = indices[0, :, None] * object_path(lens, view, start)
    length = phase + rays.path - indices[-1, :, None] * distance
    waves = (length[..., :1] - length) / (1e-3 * torch.tensor(view.wavelengths_um, dtype=lens.dtype)[:, None])
    return torch.where(meets & meets[..., :1], waves, torch.nan)[..., 1:]


def _to_sphere(rays: Rays, centre: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor]:
    """Follow rays from the image plane back to the sphere of radius R = 1 / c around `centre`.

    Returns:
        t - R [mm]; and whether the ray is valid and meets the sphere.
    """
    dx, dy = (torch.where(rays.valid, v, 0.0) for v in (rays.x - centre[..., 0], rays.y - centre[..., 1]))
    along = dx * rays.l + dy * rays.m
    q = along.square() - dx.square() - dy.square()
    squared = 1 + curvature.square() * q
    meets = rays.valid & (squared > 0) & curvature.isfinite()
    root = torch.sqrt(torch.where(meets, squared, 1.0))
    return along + curvature * q / (1 + root), meets


def rms_wavefront_error(opd: Tensor, pupil: Tensor) -> Tensor:
    """Compute the RMS (...) over the valid points without piston and tilt, relative to the best-fitting image point.

    Piston and tilt are fitted to the valid points by least squares. Differentiable in `opd`.

    Args:
        opd: (..., N) optical path differences, as from `path_differences`; NaN where a ray is lost.
        pupil: (N, 2) points of the unit disc, of equal weight.

    Returns:
        The RMS in the unit of `opd`; NaN if the valid points do not determine piston and tilt.
    """
    x, y = pupil.to(opd.dtype).unbind(-1)
    terms, valid = torch.stack([torch.ones_like(x), 2 * x, 2 * y], -1), ~opd.isnan()
    path = torch.where(valid, opd, 0.0)
    normal = torch.einsum("...p,pj,pk->...jk", valid.to(opd.dtype), terms, terms)
    strength = torch.linalg.eigvalsh(normal)
    determined = strength[..., 0] > _WEAKEST * strength[..., -1]
    normal = torch.where(determined[..., None, None], normal, torch.eye(3, dtype=opd.dtype))
    coefficients = torch.linalg.solve(normal, (path @ terms)[..., None])[..., 0]
    squared = torch.where(valid, path - coefficients @ terms.mT, 0.0).square().sum(-1)
    return torch.where(determined, torch.sqrt(squared / valid.sum(-1).clamp(min=1)), torch.nan)
