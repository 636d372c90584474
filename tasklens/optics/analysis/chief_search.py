"""Chief rays that are not found from the axis outward, from a search over all launch points in their meridian."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from tasklens.optics.analysis.continuation import Aim, Solution, newton, rays_at_stop
from tasklens.optics.analysis.object_points import rays_from_object
from tasklens.optics.rays import RayStatus

_SAMPLES = 2048
_BISECTIONS = 32  # Newton's iteration follows


def search_chief_rays(aim: Aim) -> Solution:
    """Solve for the launch points of chief rays, which meet the stop surface in its centre.

    For each field, parallel rays (or rays of its object point) are launched in its meridian at distances from the first
    vertex, q = track tan(w) for equal steps of w. Where rays begin to be lost, the last one is found by bisection. A
    chief ray is between two rays that meet the stop on opposite sides of its centre; of several, that with the least
    angle at the stop whose pupil is not folded is the solution.
    """
    count, lens = len(aim.tangents), aim.lens
    length = aim.tangents.norm(dim=-1)
    along = aim.tangents / torch.where(length > 0, length, 1.0)[:, None]

    def trace(q: Tensor, ray: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return heights at the stop of rays at distances q (K, N), cosines of angles, and whether rays arrive."""
        point = along[ray, None] * (q * torch.sqrt(1 + length[ray, None].square()))[..., None]
        start = rays_from_object(point, aim.tangents[ray, None], aim.vergence)
        at = rays_at_stop(lens, start, aim.indices[:, ray], aim.curved)
        return at.x * along[ray, :1] + at.y * along[ray, 1:], at.n, at.valid

    def bisect(low: Tensor, high: Tensor, ray: Tensor, like_low: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            height, _, valid = (v[:, 0] for v in trace(middle[:, None], ray))
            same = like_low(height, valid)
            low, high = torch.where(same, middle, low), torch.where(same, high, middle)
        return low

    w = torch.linspace(-math.pi / 2, math.pi / 2, _SAMPLES + 2, dtype=torch.float64)[1:-1]
    q = (lens.thickness.abs().sum() * torch.tan(w)).repeat(count, 1)
    height, _, valid = trace(q, torch.arange(count))
    for step in (1, -1):
        neighbour = torch.roll(valid, step, 1)
        neighbour[:, 0 if step == 1 else -1] = False
        ray, i = (~valid & neighbour).nonzero().unbind(1)
        if not len(ray):
            continue
        q[ray, i] = bisect(q[ray, i - step], q[ray, i], ray, lambda _, valid: valid)
        height[ray, i] = trace(q[ray, i, None], ray)[0][:, 0]
        valid[ray, i] = True
    status = torch.full((count,), int(RayStatus.MISSED), dtype=torch.int8)
    solution = Solution(torch.zeros_like(along), status, torch.full_like(status, lens.stop))
    above = height > 0
    ray, i = (valid[:, 1:] & valid[:, :-1] & (above[:, 1:] != above[:, :-1])).nonzero().unbind(1)
    if not len(ray):
        return solution
    side = above[ray, i]
    root = bisect(q[ray, i], q[ray, i + 1], ray, lambda height, valid: valid & ((height > 0) == side))
    cosine = trace(root[:, None], ray)[1][:, 0]

    guess = along[ray] * (root * torch.sqrt(1 + length[ray].square()))[:, None]
    solved, converged = newton(aim.part(ray), guess)
    for k in cosine.argsort().tolist():  # the least angle is the last
        if converged[k]:
            solution.point[ray[k]] = solved.point[k]
            solution.status[ray[k]], solution.lost_at[ray[k]] = int(RayStatus.OK), -1
    return solution
