"""A clear aperture that stops the outermost rays of the outer fields, as in most phone lenses."""

from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import OUTLINE, trace_fields_full
from tasklens.optics.lens import Lens
from tasklens.optics.view import View

_RAYS = 4096  # rays per field and colour for an aperture


def smallest_aperture(heights: Tensor, weight: Tensor, axial: Tensor, loss: float) -> Tensor:
    """Compute the smallest clear radius that passes the axial beam, and all but a fraction `loss` of any other beam.

    Args:
        heights: (F, W, N) distances of rays from the axis [mm]; infinite for a lost ray.
        weight: (N,) fractions of the light of a field and colour; their sum is 1.
        axial: distances of the rays of the axial beam from the axis [mm].
        loss: largest fraction of the light of a field that is stopped.
    """
    ordered, order = heights.flatten(1).sort(-1)
    energy = weight.repeat(heights.shape[1])[order].cumsum(-1) / heights.shape[1]
    enough = (energy < 1 - loss).sum(-1, keepdim=True)
    return torch.maximum(ordered.gather(-1, enough).max(), axial.max())


def heights_at(lens: Lens, view: View, pupil: Tensor, surface: int) -> Tensor:
    """Compute the distances (F, W, N) from the axis at which rays pass a surface [mm]; infinite for a lost ray."""
    rays = trace_fields_full(lens.detached(), view, pupil)[1][surface]
    return torch.where(rays.lost_at < 0, torch.hypot(rays.x, rays.y), torch.inf)


def with_vignetting_aperture(lens: Lens, view: View, surface: int, loss: float) -> Lens:
    """Return the lens with the smallest clear aperture of a surface that stops at most `loss` of any field."""
    heights = heights_at(lens, view, torch.cat([sobol_disc(_RAYS, seed=0), OUTLINE]), surface)
    weight = torch.full((_RAYS,), 1 / _RAYS, dtype=heights.dtype)
    semi_diameter = lens.semi_diameter.clone()
    semi_diameter[surface] = smallest_aperture(heights[..., :_RAYS], weight, heights[view.radii.argmin()], loss)
    return replace(lens, semi_diameter=semi_diameter)
