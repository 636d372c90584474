"""Chief rays of wide-angle lenses, from a search over all rays through the centre of the stop."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from tasklens.materials.material import AIR
from tasklens.optics.analysis.continuation import Aim, Solution, newton
from tasklens.optics.lens import Lens
from tasklens.optics.rays import RayStatus, launch
from tasklens.optics.tracing.trace import trace

_ANGLES = 1024  # rays from the axis to 90 degrees
_SUBDIVISIONS = 32, 32, 32  # of intervals in which rays begin to be lost
_BISECTIONS = 60


def search_chief_rays(aim: Aim) -> Solution:
    """Solve for the launch points of chief rays, whose target is the centre of the stop.

    Rays are traced backward from the centre of the stop, at all angles u in one meridian. Behind the first surface they
    have the height y and the slope s; the chief ray of an object point in the direction T has |s - v y| = |T|, with the
    vergence v. The first such ray from the axis outward that also arrives forward is the solution.
    """
    field = aim.tangents.norm(dim=-1)
    along = aim.tangents / torch.where(field > 0, field, 1.0)[:, None]
    status = torch.full((len(field),), int(RayStatus.MISSED), dtype=torch.int8)
    solution = Solution(torch.zeros_like(along), status, torch.full_like(status, aim.lens.stop))
    lens, indices = _backward(aim)

    def leave(u: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Trace rays backward at the angles u (M, N); return height, s - v y, and whether they leave the lens."""
        zero = torch.zeros_like(u)
        out = trace(lens, launch(zero, zero, zero, zero, torch.sin(u), torch.cos(u)), indices[:, rays])
        return out.y, -out.m / out.n - aim.vergence * out.y, out.valid

    every = torch.arange(len(field))
    u = torch.linspace(0, math.pi / 2, _ANGLES + 1, dtype=torch.float64)[:-1]
    for count in _SUBDIVISIONS:
        _, slope, valid = leave(u.expand(len(field), -1), every)
        ends = (valid[:, 1:] != valid[:, :-1]).any(0).nonzero()[:, 0]
        inner = torch.linspace(0, 1, count + 1, dtype=torch.float64)[1:-1]
        u = torch.cat([u, torch.lerp(u[ends, None], u[ends + 1, None], inner).flatten()]).sort().values
    _, slope, valid = leave(u.expand(len(field), -1), every)
    excess = slope.abs() - field[:, None]
    crosses = valid[:, 1:] & valid[:, :-1] & ((excess[:, 1:] >= 0) != (excess[:, :-1] >= 0))
    pending = every[crosses.any(1)]
    while len(pending):
        first = crosses[pending].int().argmax(1)
        low, high = u[first], u[first + 1]
        rising = excess[pending, first] < 0
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            _, slope, valid = (v[:, 0] for v in leave(middle[:, None], pending))
            before = ((slope.abs() < field[pending]) == rising) & valid
            low, high = torch.where(before, middle, low), torch.where(before, high, middle)
        y, slope, _ = (v[:, 0] for v in leave(low[:, None], pending))
        guess = (y * torch.sign(slope))[:, None] * along[pending]
        found, converged = newton(aim.part(pending), guess)
        solution.point[pending[converged]] = found.point[converged]
        solution.status[pending[converged]], solution.lost_at[pending[converged]] = int(RayStatus.OK), -1
        crosses[pending, first] = False
        pending = pending[~converged & crosses[pending].any(1)]
    return solution


def _backward(aim: Aim) -> tuple[Lens, Tensor]:
    """Return the surfaces in front of the stop in reverse order, behind a plane at the stop, and their indices."""
    stop, lens = aim.lens.stop, aim.lens
    plane = torch.zeros(1, dtype=lens.dtype)
    back = Lens(
        curvature=torch.cat([plane, -lens.curvature[:stop].flip(0)]),
        conic=torch.cat([plane, lens.conic[:stop].flip(0)]),
        alpha=torch.cat([torch.zeros_like(lens.alpha[:1]), -lens.alpha[:stop].flip(0)]),
        thickness=torch.cat([lens.thickness[:stop].flip(0), plane]),
        semi_diameter=torch.full((stop + 1,), torch.inf, dtype=lens.dtype),
        media=(AIR,) * (stop + 1),
        stop=0,
    )
    return back, torch.cat([aim.indices[stop : stop + 1], aim.indices[: stop + 1].flip(0)])
