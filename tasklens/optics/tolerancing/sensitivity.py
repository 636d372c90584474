"""Displacement of rays by errors of manufacture, by derivative.

Displacements are of the core of each spot, the half of its rays nearest to the chief ray, so that they do not depend on
a haze around it; without the shift of a whole spot, and in the best image plane of all four quadrants.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, distances, encircled_energy_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.tolerancing.errors import Error, built
from tasklens.optics.view import View


def displacements(lens: Lens, view: View, found: Sequence[Error], rays: int) -> Tensor:
    """Compute the RMS displacement (P,) of core rays by each error of the size of its tolerance, refocused [um].

    A plane at the distance t moves rays by t times their slopes q, so that displacements d + t q are least in the mean
    square at t = -<d, q> / <q, q>. They are linear in the error: the mean square of a spot grows by the sum over errors
    of the squares times `DEVIATION`^2.

    Args:
        found: P errors of the lens.
        rays: number of pupil points per field and colour.

    Returns:
        Infinite for all errors where no light comes to some field.
    """
    view, pupil = view.in_all_quadrants(), sobol_disc(rays, seed=0)
    nominal = trace_fields(lens, view, pupil)
    core = _core(lens, view, nominal)
    if not core.any(-1).any(-1).all():
        return torch.full((len(found),), torch.inf, dtype=torch.float64)

    def points(fractions: Tensor) -> Tensor:
        moved = trace_fields(built(lens, found, fractions, view.reference), view, pupil)
        return torch.stack([moved.x, moved.y])

    nought = torch.zeros(len(found), dtype=torch.float64)
    slopes = _centred(torch.stack([nominal.l / nominal.n, nominal.m / nominal.n]), core)
    squares = []
    for along in torch.eye(len(found), dtype=torch.float64):
        moved = _centred(torch.func.jvp(points, (nought,), (along,))[1], core)  # type: ignore[misc]
        squares.append(_mean(moved * moved, core) - _mean(moved * slopes, core) ** 2 / _mean(slopes * slopes, core))
    return 1e3 * torch.stack(squares).clamp(min=0).sqrt()


def traced_displacements(lens: Lens, view: View, found: Sequence[Error], rays: int) -> Tensor:
    """Compute the same with errors one at a time, of both signs, from traced rays; infinite where a field is lost."""
    view, pupil = view.in_all_quadrants(), sobol_disc(rays, seed=0)
    nominal = trace_fields(lens, view, pupil)
    core = _core(lens, view, nominal)

    def squared(fractions: Tensor) -> float:
        moved = trace_fields(built(lens, found, fractions, view.reference), view, pupil)
        kept = core & moved.valid
        if not kept.any(-1).any(-1).all():
            return float("inf")
        d = _centred(torch.stack([moved.x - nominal.x, moved.y - nominal.y]), kept)
        q = _centred(torch.stack([moved.l / moved.n, moved.m / moved.n]), kept)
        return float(_mean(d * d, kept) - _mean(d * q, kept) ** 2 / _mean(q * q, kept))

    both = [squared(e) + squared(-e) for e in torch.eye(len(found), dtype=torch.float64)]
    return 1e3 * (torch.tensor(both, dtype=torch.float64) / 2).clamp(min=0).sqrt()


def _core(lens: Lens, view: View, rays: Rays) -> Tensor:
    """Tell which rays (F, W, N) are of the core; none of a field without light."""
    centre = chief_points(lens, view)
    return rays.valid & (distances(rays, centre) <= encircled_energy_radius(rays, centre, 0.5)[:, None, None])


def _mean(product: Tensor, core: Tensor) -> Tensor:
    """Compute the mean over fields of the mean over core rays of a sum over x and y, (2, F, W, N)."""
    return (torch.where(core, product.sum(0), 0.0).sum((1, 2)) / core.sum((1, 2))).mean()


def _centred(values: Tensor, core: Tensor) -> Tensor:
    """Subtract from values (2, F, W, N) of core rays their mean in each field."""
    mean = torch.where(core, values, 0.0).sum((2, 3), keepdim=True) / core.sum((1, 2))[:, None, None]
    return torch.where(core, values - mean, 0.0)
