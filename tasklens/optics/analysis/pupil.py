"""Pupil sampling, and ray bundles of fields."""

import math
from dataclasses import replace
from numbers import Integral

import torch
from torch import Tensor

from tasklens.optics.analysis.aiming import aim, stop_is_inside
from tasklens.optics.analysis.object_points import check_in_front, rays_from_object, vertex_tangents
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError


def check_rays(count: int) -> None:
    """Raise InputError if a number of rays is not a whole number from 1."""
    if not (isinstance(count, Integral) and count >= 1):
        raise InputError(f"rays: expected a whole number from 1, got {count!r}")


def sobol_disc(count: int, seed: int) -> Tensor:
    """Return (count, 2) points of a scrambled Sobol sequence, uniform over the unit disc.

    Raises:
        InputError: `count` is not a whole number from 1.
    """
    check_rays(count)
    engine = torch.quasirandom.SobolEngine(2, scramble=True, seed=seed)
    u, v = engine.draw(count, dtype=torch.float64).unbind(-1)
    radius, angle = torch.sqrt(u), 2 * math.pi * v
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], -1)


def rim(count: int) -> Tensor:
    """Return (count, 2) equally spaced points on the unit circle."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    return torch.stack([torch.cos(angle), torch.sin(angle)], -1)


def gauss_quadrature(rings: int, arms: int) -> tuple[Tensor, Tensor]:
    """Return points on the half disc x > 0 and their weights, which sum to 1, for an integrand even in x.

    Gauss-Legendre in rho^2 and equal steps in angle (Forbes 1988, J. Opt. Soc. Am. A 5, 1943): exact for
    polynomials of degree 4 rings - 2 in rho.

    Returns:
        (rings * arms, 2) points of the unit disc, (rings * arms,) weights.
    """
    import numpy

    node, weight = numpy.polynomial.legendre.leggauss(rings)
    radius = torch.from_numpy(numpy.sqrt((node + 1) / 2))
    angle = (torch.arange(arms, dtype=torch.float64) + 0.5) * math.pi / arms - math.pi / 2
    points = torch.stack([radius[:, None] * torch.cos(angle), radius[:, None] * torch.sin(angle)], -1)
    weights = torch.from_numpy(weight / 2)[:, None].expand(rings, arms) / arms
    return points.reshape(-1, 2), weights.reshape(-1)


def check_stop(lens: Lens) -> None:
    """Check that the stop lets light through and limits it; raises InputError.

    With a stop of radius 0 every ray is the chief ray, and any lens seems perfect.
    """
    radius = float(lens.semi_diameter[lens.stop].detach())
    if not 0 < radius < math.inf:
        raise InputError(
            f"surface {lens.stop}: semi_diameter: the radius of the stop is {radius} mm; expected a positive and finite"
            " one; correct it"
        )


def launch_fields(lens: Lens, view: View, pupil: Tensor, wavelengths: tuple[float, ...] | None = None) -> Rays:
    """Launch the bundles of all fields that fill the stop, at the first vertex plane.

    A stop in front of the lens, or on its first surface, is its own entrance pupil. Rays are aimed at a stop inside the
    lens: each meets its surface at (x, y) = pupil point times radius of the stop, at every field and wavelength.

    Args:
        lens: the lens.
        view: fields and object distance.
        pupil: (N, 2) points of the unit disc.
        wavelengths: W wavelengths [um]; None: those of the view.

    Returns:
        Rays of shape (F, W, N). Rays that cannot be aimed are lost.

    Raises:
        InputError: the stop has no radius, or an infinite one; or the object is in the lens.
    """
    check_stop(lens)
    wavelengths = wavelengths or view.wavelengths_um
    first_order = paraxial(lens, wavelengths[len(wavelengths) // 2])
    tangents, vergence, pupil = vertex_tangents(lens, view), view.object_vergence, pupil.to(lens.dtype)
    if stop_is_inside(lens):
        entrance_pupil = torch.stack([first_order.entrance_pupil_radius, first_order.entrance_pupil_z])
        indices = lens.refractive_indices(wavelengths)
        point, status, lost_at = aim(lens, tangents, vergence, pupil, indices, entrance_pupil)
        rays = rays_from_object(point.to(lens.dtype), tangents[:, None, None], vergence)
        rays = replace(rays, status=status, lost_at=lost_at)
    else:
        points = pupil * first_order.entrance_pupil_radius
        z = first_order.entrance_pupil_z + lens.surfaces[lens.stop].sag(*points.unbind(-1))
        point = torch.stack([points[:, k] - tangents[:, k, None, None] * z for k in (0, 1)], -1)
        if vergence:
            point = point / (1 + z * vergence)[:, None]
        point = point.expand(-1, len(wavelengths), -1, -1)
        rays = rays_from_object(point, tangents[:, None, None], vergence)
    if vergence:
        check_in_front(lens, view, rays)
    return rays
