"""Displacement of rays by manufacturing errors, from derivatives.

Only the core of each spot counts, the half of its rays nearest to the chief ray: a haze around it has no effect. The
shift of a whole spot is removed, and the image plane is the best one for all four quadrants.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, distances, encircled_energy_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.tolerancing.manufacturing_errors import Error, with_errors
from tasklens.optics.view import View


def displacements(lens: Lens, view: View, errors: Sequence[Error], rays: int) -> Tensor:
    """Compute the RMS displacement (P,) of core rays by each error as large as its tolerance, after refocusing [um].

    A defocus t displaces rays by t times their slopes q. The mean square of the displacements d + t q is smallest at
    t = -<d, q> / <q, q>. Displacements are linear in the error: the mean square of a spot grows by `DEVIATION`^2 times
    the sum of their squares.

    Args:
        errors: P errors of the lens.
        rays: number of pupil points per field and colour.

    Returns:
        The displacements; all are infinite if no light reaches some field.
    """
    view, pupil = view.in_all_quadrants(), sobol_disc(rays, seed=0)
    nominal = trace_fields(lens, view, pupil)
    core = _core(lens, view, nominal)
    if not core.any(-1).any(-1).all():
        return torch.full((len(errors),), torch.inf, dtype=torch.float64)

    def points(fractions: Tensor) -> Tensor:
        moved = trace_fields(with_errors(lens, errors, fractions, view.reference_um), view, pupil)
        return torch.stack([moved.x, moved.y])

    zero = torch.zeros(len(errors), dtype=torch.float64)
    slopes = _centre(torch.stack([nominal.l / nominal.n, nominal.m / nominal.n]), core)
    squares = []
    for along in torch.eye(len(errors), dtype=torch.float64):
        moved = _centre(torch.func.jvp(points, (zero,), (along,))[1], core)  # type: ignore[misc]
        squares.append(_mean(moved * moved, core) - _mean(moved * slopes, core) ** 2 / _mean(slopes * slopes, core))
    return 1e3 * torch.stack(squares).clamp(min=0).sqrt()


def traced_displacements(lens: Lens, view: View, errors: Sequence[Error], rays: int) -> Tensor:
    """Compute `displacements` from rays traced with one error at a time, of both signs; infinite if a field is lost."""
    view, pupil = view.in_all_quadrants(), sobol_disc(rays, seed=0)
    nominal = trace_fields(lens, view, pupil)
    core = _core(lens, view, nominal)

    def mean_square(fractions: Tensor) -> float:
        moved = trace_fields(with_errors(lens, errors, fractions, view.reference_um), view, pupil)
        valid = core & moved.valid
        if not valid.any(-1).any(-1).all():
            return float("inf")
        d = _centre(torch.stack([moved.x - nominal.x, moved.y - nominal.y]), valid)
        q = _centre(torch.stack([moved.l / moved.n, moved.m / moved.n]), valid)
        return float(_mean(d * d, valid) - _mean(d * q, valid) ** 2 / _mean(q * q, valid))

    squares = [mean_square(e) + mean_square(-e) for e in torch.eye(len(errors), dtype=torch.float64)]
    return 1e3 * (torch.tensor(squares, dtype=torch.float64) / 2).clamp(min=0).sqrt()


def _core(lens: Lens, view: View, rays: Rays) -> Tensor:
    """Return whether rays (F, W, N) belong to the core; a field without light has no core rays."""
    centre = chief_points(lens, view)
    return rays.valid & (distances(rays, centre) <= encircled_energy_radius(rays, centre, 0.5)[:, None, None])


def _mean(product: Tensor, core: Tensor) -> Tensor:
    """Sum (2, F, W, N) over x and y; return the mean over fields of the mean over core rays."""
    return (torch.where(core, product.sum(0), 0.0).sum((1, 2)) / core.sum((1, 2))).mean()


def _centre(values: Tensor, core: Tensor) -> Tensor:
    """Subtract the mean of each field from the values (2, F, W, N) of core rays; zero for other rays."""
    mean = torch.where(core, values, 0.0).sum((2, 3), keepdim=True) / core.sum((1, 2))[:, None, None]
    return torch.where(core, values - mean, 0.0)
