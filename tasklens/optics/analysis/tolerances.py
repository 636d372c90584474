"""Displacement of rays by moulding errors of radii and thicknesses.

An error changes one radius or one thickness at a time; the image plane is then refocused, as a camera module of a phone
is focused in assembly. Displacements are of the core of each spot, the half of its rays nearest to the chief ray, so
that they do not depend on a haze around it. Tilt and decentre are not simulated, since the tracer of designs is limited
to rotationally symmetric lenses.
"""

from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, distances, encircled_energy_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View

# Precision moulding of plastic lenses, apollooptical.com/manufacturing-tolerances: +- 0.5 % and +- 0.015 mm.
RADIUS = 0.005  # error of a radius of curvature, as a fraction
THICKNESS = 0.015  # error of a centre thickness [mm]; we take it for air spaces too


def displacements(lens: Lens, view: View, rays: int) -> dict[str, float]:
    """Compute the RMS displacement of the rays of the core by the error of each part, refocused [um].

    It is the root mean square over fields, their rays and both signs of the error, without the shift of a whole spot.
    To first order the mean square of a spot grows by its square, on average over independent errors of both signs. A
    part is `radius i`, or `thickness i` behind surface i, air too. Infinite where a field loses its core.

    Args:
        rays: number of pupil points per field and colour.
    """
    pupil = sobol_disc(rays, seed=0)
    nominal = trace_fields(lens, view, pupil)
    centre = chief_points(lens, view)
    core = distances(nominal, centre) <= encircled_energy_radius(nominal, centre, 0.5)[:, None, None]
    found = {}

    def record(part: str, name: str, surface: int, error: float) -> None:
        lenses = (_changed(lens, name, surface, by) for by in (error, -error))
        squares = [_displacement(changed, view, pupil, nominal, core) for changed in lenses]
        found[part] = 1e3 * (sum(squares) / 2) ** 0.5

    for i in lens.refracting_surfaces:
        record(f"radius {i}", "curvature", i, RADIUS * float(lens.curvature[i]))
    for i in range(lens.refracting_surfaces[0], lens.refracting_surfaces[-1]):
        record(f"thickness {i}", "thickness", i, THICKNESS)
    return found


def _changed(lens: Lens, name: str, surface: int, by: float) -> Lens:
    values = getattr(lens, name).clone()
    values[surface] += by
    return replace(lens, **{name: values})


def _displacement(lens: Lens, view: View, pupil: Tensor, nominal: Rays, core: Tensor) -> float:
    """Compute the mean squared displacement of core rays from the nominal ones in the best image plane [mm^2].

    A plane at the distance t moves rays by t times their slopes q, so that displacements d + t q are least in the mean
    square at t = -<d, q> / <q, q>.
    """
    moved = trace_fields(lens, view, pupil)
    kept = core & moved.valid
    count = kept.sum((1, 2), keepdim=True)
    if not count.all():
        return float("inf")

    def centred(v: Tensor) -> Tensor:
        v = torch.where(kept, v, 0.0)
        return torch.where(kept, v - v.sum((1, 2), keepdim=True) / count, 0.0)

    d = torch.stack([centred(moved.x - nominal.x), centred(moved.y - nominal.y)])
    q = torch.stack([centred(moved.l / moved.n), centred(moved.m / moved.n)])
    dd, dq, qq = ((product / count / len(count)).sum() for product in (d * d, d * q, q * q))
    return float((dd - dq**2 / qq).clamp(min=0))
