"""Launch points of bundles of many rays that fill the stop, from a polynomial through a few of them.

Chief rays that are not found from the axis outward are searched for among all launch points in their meridian.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tasklens.optics.analysis.continuation import Aim, Solution, follow, newton, rays_at_stop, stop_is_curved
from tasklens.optics.analysis.object_points import rays_from_object
from tasklens.optics.lens import Lens
from tasklens.optics.rays import RayStatus

_DEGREE = 9  # degree of the polynomial
_RINGS, _ARMS = 7, 20  # rays that the polynomial is fitted to
_STEPS = 4  # largest number of steps with the derivative of the polynomial
_TOLERANCE = 2e-15  # estimated error after such a step / track
_BEST_RATIO = 0.1  # smallest plausible ratio of the errors after and before a step
_SAMPLES = 2048  # launch points of a search
_BISECTIONS = 32  # Newton's iteration follows


@dataclass(frozen=True)
class _Bundles:
    """Bundles of F fields in W colours, or of one field for each colour.

    Attributes:
        lens: a lens with its stop inside, in double precision as all tensors.
        tangents: (F, 1, 2) direction tangents of the object points as seen from the first vertex, or (1, W, 2).
        vergence: 1 / distance of the object from the first vertex [1/mm].
        indices: (S + 1, W) refractive indices.
        entrance_pupil: (2,) radius and position of the paraxial entrance pupil [mm].
        chief: (W, 2) launch points of chief rays, from which rays are followed; None: from the axis.
    """

    lens: Lens
    tangents: Tensor
    vergence: float
    indices: Tensor
    entrance_pupil: Tensor
    chief: Tensor | None = None

    def aims(self, pupil: Tensor) -> Aim:
        """List the rays (F, W, N) through N points of the unit disc."""
        size = (len(self.tangents), self.indices.shape[1], len(pupil))
        radius, z = self.entrance_pupil
        paraxial = (pupil * radius - self.tangents[:, :, None] * z) / (1 + z * self.vergence)
        return Aim(
            self.lens,
            self.indices[:, None, :, None].expand(-1, *size).flatten(1),
            self.tangents[:, :, None].expand(*size, 2).reshape(-1, 2),
            self.vergence,
            (pupil * self.lens.semi_diameter[self.lens.stop]).expand(*size, 2).reshape(-1, 2),
            paraxial.expand(*size, 2).reshape(-1, 2),
            stop_is_curved(self.lens),
            None if self.chief is None else self.chief.repeat_interleave(len(pupil), 0),
        )


def solve_bundles(
    lens: Lens, tangents: Tensor, vergence: float, pupil: Tensor, indices: Tensor, entrance_pupil: Tensor
) -> Solution:
    """Solve for the launch points of all rays (F, W, N), without graph.

    Rays are followed from the axis outward. Those that are lost there are followed from their chief ray, which is
    searched for if it is lost, too: at 80 degrees the way from the axis is too long.

    Args:
        lens: a lens with its stop inside, in double precision as all arguments.
        tangents: (F, 2) direction tangents of the object points as seen from the first vertex.
        vergence: 1 / distance of the object from the first vertex [1/mm].
        pupil: (N, 2) points of the unit disc.
        indices: (S + 1, W) refractive indices.
        entrance_pupil: (2,) radius and position of the paraxial entrance pupil [mm].

    Returns:
        The launch points of F W N rays.
    """
    solution = _solve(_Bundles(lens, tangents[:, None], vergence, indices, entrance_pupil), pupil)
    lost = (solution.status != RayStatus.OK).reshape(-1, len(pupil))
    if not bool(lost.any()):
        return solution
    bundle, colours = lost.any(1).nonzero()[:, 0], indices.shape[1]
    part = _Bundles(lens, tangents[None, bundle // colours], vergence, indices[:, bundle % colours], entrance_pupil)
    chief_aims = part.aims(torch.zeros_like(pupil[:1]))
    chief = follow(chief_aims, chief_aims.paraxial)
    far = (chief.status != RayStatus.OK).nonzero()[:, 0]
    if len(far):
        searched = search_chief_rays(chief_aims.part(far))
        chief.point[far], chief.status[far] = searched.point, searched.status
    exists = chief.status == RayStatus.OK
    if bool(exists.any()):
        tangents, indices = part.tangents[:, exists], part.indices[:, exists]
        again = _solve(replace(part, tangents=tangents, indices=indices, chief=chief.point[exists]), pupil)
        aimed = (again.status == RayStatus.OK) & lost[bundle[exists]].flatten()
        ray = torch.arange(lost.numel()).reshape(lost.shape)[bundle[exists]].flatten()[aimed]
        for name, values in vars(again).items():
            getattr(solution, name)[ray] = values[aimed]
    return solution


def _solve(bundles: _Bundles, pupil: Tensor) -> Solution:
    """Solve for the launch points of all rays by following them from the axis, or from chief rays.

    Bundles of few rays are solved ray by ray (`continuation`). For larger bundles a coarse set of rays is solved, and a
    polynomial P of the pupil point is fitted to their launch points. P gives the initial launch points of all rays.
    Steps with the derivative of P, at the cost of one trace each, bring the rays to their points on the stop:

        x <- x - dP r / R,  r the error at the stop, R the radius of the stop

    The error after a step is estimated from its ratio to the previous error. Rays that are still too far off are solved
    ray by ray.
    """
    aims = bundles.aims(pupil)
    coarse = _coarse_pupil()
    if len(pupil) <= 2 * len(coarse):
        return follow(aims, aims.start)
    lens, tangents, indices = bundles.lens, bundles.tangents, bundles.indices
    coarse_aims = bundles.aims(coarse)
    size = (len(tangents), indices.shape[1], len(pupil))
    point, slope = _fit(follow(coarse_aims, coarse_aims.start), coarse, pupil, size)
    radius, track = lens.semi_diameter[lens.stop], lens.thickness.abs().sum()
    before = torch.zeros(size, dtype=torch.float64)
    for _ in range(_STEPS):
        at = rays_at_stop(lens, rays_from_object(point, tangents[:, :, None], bundles.vergence), indices, aims.curved)
        error = torch.stack([at.x, at.y], -1) - pupil * radius
        r = error.norm(dim=-1)
        near = at.valid & (r * (r / before).clamp(_BEST_RATIO, 1) <= _TOLERANCE * track)
        point = point - (slope @ error[..., None])[..., 0] / radius
        before = r.clamp(min=_TOLERANCE * track)
        if bool(near.all()):
            break
    near, point = near.flatten(), point.reshape(-1, 2)
    status = torch.zeros(len(point), dtype=torch.int8)
    lost_at = status - 1
    far = (~near).nonzero()[:, 0]
    if len(far):
        solution = follow(aims.part(far), point[far])
        point[far], status[far], lost_at[far] = solution.point, solution.status, solution.lost_at
    return Solution(point, status, lost_at)


def _fit(solution: Solution, coarse: Tensor, pupil: Tensor, size: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Fit polynomials to the aimed rays by least squares; a bundle without aimed rays gets zeros.

    Returns:
        (F, W, N, 2) launch points at `pupil`, (F, W, N, 2, 2) their derivatives by the pupil point.
    """
    fields, colours, _ = size
    aimed = (solution.status == RayStatus.OK).reshape(fields * colours, -1, 1).double()
    values = solution.point.reshape(fields * colours, -1, 2)
    coefficients = torch.linalg.lstsq(aimed * _powers(coarse)[0], aimed * values).solution
    point, *slopes = ((terms @ coefficients).reshape(*size, 2) for terms in _powers(pupil))
    return point, torch.stack(slopes, -1)


def _powers(pupil: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute x^i y^j up to the degree i + j of the polynomial, (N, K), and their derivatives by x and by y."""
    orders = torch.arange(_DEGREE + 1)
    powers = pupil ** orders[:, None, None]
    slopes = orders[:, None, None] * powers.roll(1, 0)
    i, j = torch.cartesian_prod(orders, orders).T
    i, j = i[i + j <= _DEGREE], j[i + j <= _DEGREE]
    (x, y), (dx, dy) = powers.unbind(-1), slopes.unbind(-1)
    return (x[i] * y[j]).T, (dx[i] * y[j]).T, (x[i] * dy[j]).T


def _coarse_pupil() -> Tensor:
    """Return points on rings, denser towards the rim, and the centre."""
    radius = torch.sin(torch.arange(1, _RINGS + 1, dtype=torch.float64) * (math.pi / 2 / _RINGS))
    angle = torch.arange(_ARMS, dtype=torch.float64) * (2 * math.pi / _ARMS)
    ring = torch.stack([torch.cos(angle), torch.sin(angle)], -1)
    return torch.cat([(radius[:, None, None] * ring).reshape(-1, 2), torch.zeros(1, 2, dtype=torch.float64)])


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
