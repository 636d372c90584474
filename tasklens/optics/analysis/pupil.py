"""Pupil sampling, and collimated ray bundles of fields."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.aiming import aim, stop_is_inside
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, launch
from tasklens.runtime.errors import InputError


def sobol_disc(count: int, seed: int) -> Tensor:
    """Return (count, 2) points of a scrambled Sobol sequence, uniform over the unit disc."""
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

    Every ray of a stop of radius 0 is the chief ray: the lens would be perfect.
    """
    radius = float(lens.semi_diameter[lens.stop].detach())
    if not 0 < radius < math.inf:
        raise InputError(
            f"surface {lens.stop}: semi_diameter: the radius of the stop is {radius} mm; expected a positive and finite"
            " one; correct it"
        )


def collimated_rays(lens: Lens, tangents: Tensor, pupil: Tensor, wavelengths: tuple[float, ...]) -> Rays:
    """Launch collimated bundles that fill the stop, at the first vertex plane.

    A stop in front of the lens, or on its first surface, is its own entrance pupil. Rays are aimed at a stop inside:
    each meets its surface at (x, y) = pupil point times radius of the stop, at every field and wavelength.

    Args:
        lens: the lens.
        tangents: (F, 2) direction tangents (l / n, m / n) of the fields.
        pupil: (N, 2) points of the unit disc.
        wavelengths: W wavelengths [um].

    Returns:
        Rays of shape (F, W, N). Those that cannot be aimed are lost.

    Raises:
        InputError: the stop has no radius, or an infinite one.
    """
    check_stop(lens)
    first_order = paraxial(lens, wavelengths[len(wavelengths) // 2])
    tangents, pupil = tangents.to(lens.dtype), pupil.to(lens.dtype)
    n = torch.rsqrt(1 + tangents.square().sum(-1))
    tx, ty = tangents[:, 0, None, None], tangents[:, 1, None, None]
    n = n[:, None, None].expand(len(tangents), len(wavelengths), len(pupil))
    if stop_is_inside(lens):
        entrance_pupil = torch.stack([first_order.entrance_pupil_radius, first_order.entrance_pupil_z])
        point, status, lost_at = aim(lens, tangents, pupil, lens.refractive_indices(wavelengths), entrance_pupil)
        x, y = point.to(lens.dtype).unbind(-1)
        rays = launch(x, y, torch.zeros_like(n), tx * n, ty * n, n)
        return replace(rays, status=status, lost_at=lost_at)
    points = pupil * first_order.entrance_pupil_radius
    z = first_order.entrance_pupil_z + lens.surfaces[lens.stop].sag(*points.unbind(-1))
    x, y = points[:, 0] - tx * z, points[:, 1] - ty * z
    return launch(x, y, torch.zeros_like(n), tx * n, ty * n, n)
