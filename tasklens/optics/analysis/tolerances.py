"""Sensitivity of spots to moulding errors of radii and thicknesses.

An error changes one radius or one thickness at a time; the image plane is then refocused to the smallest mean squared
spot, as a camera module of a phone is focused in assembly. Tilt and decentre are not simulated, since the tracer is
limited to rotationally symmetric lenses.
"""

from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View

# Precision moulding of plastic lenses, apollooptical.com/manufacturing-tolerances: +- 0.5 % and +- 0.015 mm.
RADIUS = 0.005  # error of a radius of curvature, as a fraction
THICKNESS = 0.015  # error of a centre thickness [mm]; we take it for air spaces too


def errors_by_part(lens: Lens, view: View, rays: int) -> tuple[float, dict[str, float]]:
    """Compute the refocused RMS spot radius over fields and rays [um], and its increase by the error of each part.

    The increase is sqrt(rms_with^2 - rms^2) [um] for the worse sign of the error, so that independent errors add as
    squares; zero where both signs reduce the spot. A part is `radius i`, or `thickness i` behind surface i, air too.

    Args:
        rays: number of pupil points per field and colour.
    """
    pupil = sobol_disc(rays, seed=0)

    def rms(changed: Lens) -> float:
        return 1e3 * float(_refocused(trace_fields(changed, view, pupil)))

    nominal, found = rms(lens), {}

    def record(part: str, name: str, surface: int, error: float) -> None:
        worse = max(rms(_changed(lens, name, surface, by)) for by in (error, -error))
        found[part] = max(0.0, worse**2 - nominal**2) ** 0.5

    for i in lens.refracting_surfaces:
        record(f"radius {i}", "curvature", i, RADIUS * float(lens.curvature[i]))
    for i in range(lens.refracting_surfaces[0], lens.refracting_surfaces[-1]):
        record(f"thickness {i}", "thickness", i, THICKNESS)
    return nominal, found


def _changed(lens: Lens, name: str, surface: int, by: float) -> Lens:
    values = getattr(lens, name).clone()
    values[surface] += by
    return replace(lens, **{name: values})


def _refocused(rays: Rays) -> Tensor:
    """Compute the smallest RMS distance of valid rays from the centroid of their field over all image planes [mm].

    Infinite if a field has no valid ray. With points p + t q at the distance t from the image plane, the mean square is
    a parabola in t.
    """
    weight = rays.valid.to(rays.x.dtype)
    total = weight.sum((1, 2), keepdim=True)
    if not total.all():
        return torch.tensor(torch.inf)

    def centred(v: Tensor) -> Tensor:
        v = torch.where(rays.valid, v, 0.0)
        return torch.where(rays.valid, v - v.sum((1, 2), keepdim=True) / total, 0.0)

    p = torch.stack([centred(rays.x), centred(rays.y)])
    q = torch.stack([centred(rays.l / rays.n), centred(rays.m / rays.n)])
    share = weight / total / len(weight)
    pp, pq, qq = ((share * product).sum() for product in (p * p, p * q, q * q))
    return (pp - pq**2 / qq).clamp(min=0).sqrt()
