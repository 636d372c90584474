"""Launch points of single rays that meet the stop at target points, by Newton's iteration from the axis outward."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tasklens.optics.analysis.object_points import rays_from_object
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, RayStatus
from tasklens.optics.tracing.trace import trace

_NEWTON_STEPS = 8
_TOLERANCE = 1e-11  # error at the stop / track; the error after a Newton step is of the order of its square
_SHORTEST = 1 / 16  # shortest step from the axis, as a fraction of the way; 1 / 1024 aims no more rays


def rays_at_stop(lens: Lens, rays: Rays, indices: Tensor, curved: bool = True) -> Rays:
    """Trace rays (..., W, N) through the surfaces in front of the stop, ignoring apertures, to the stop surface.

    Args:
        lens: a lens with at least one surface in front of its stop.
        rays: rays at the first vertex plane.
        indices: (S + 1, W) refractive indices of the lens.
        curved: whether to continue from the vertex plane of the stop to its surface, for a curved stop.

    Returns:
        The rays, z from the vertex of the stop, differentiable like `trace`. A ray that misses a surface or is totally
        internally reflected has its status and stays at its last point.
    """
    stop = lens.stop
    shape = {name: getattr(lens, name)[:stop] for name in ("curvature", "conic", "alpha", "thickness")}
    unlimited = torch.full((stop,), torch.inf, dtype=lens.dtype)
    front = Lens(**shape, semi_diameter=unlimited, media=lens.media[:stop], stop=0)
    rays = trace(front, rays, indices[: stop + 1])
    if not curved:
        return rays
    at = replace(lens.surfaces[stop], semi_diameter=torch.inf).intersect(rays)
    lost_at = torch.where(rays.valid & ~at.valid, torch.tensor(stop, dtype=torch.int8), rays.lost_at)
    return replace(at, lost_at=lost_at)


def points_at_stop(
    lens: Lens, point: Tensor, tangents: Tensor, vergence: float, indices: Tensor, curved: bool
) -> tuple[Tensor, Tensor, Rays]:
    """Trace rays from `point` (..., W, N, 2) to the stop, without graph.

    Returns:
        (..., W, N, 2) points (x, y) on the stop [mm], (..., W, N, 2, 2) their derivatives by the launch point, and the
        rays at the stop.
    """
    with torch.enable_grad():
        point = point.detach().requires_grad_()
        at = rays_at_stop(lens, rays_from_object(point, tangents, vergence), indices, curved)
        rows = [torch.autograd.grad(v.sum(), point, retain_graph=True)[0] for v in (at.x, at.y)]
    return torch.stack([at.x, at.y], -1).detach(), torch.stack(rows, -2), at


def stop_is_curved(lens: Lens) -> bool:
    """Return whether the stop surface is not a plane."""
    return bool(lens.curvature[lens.stop] != 0) or bool(lens.alpha[lens.stop].any())


@dataclass(frozen=True)
class Aim:
    """M rays and their target points on the stop, detached and in double precision.

    Attributes:
        lens: a lens with its stop inside.
        indices: (S + 1, M) refractive indices for each ray.
        tangents: (M, 2) direction tangents of the object points as seen from the first vertex.
        vergence: 1 / distance of the object from the first vertex [1/mm].
        targets: (M, 2) points (x, y) on the stop [mm].
        paraxial: (M, 2) launch points from paraxial optics [mm].
        curved: whether the stop is curved.
        chief: (M, 2) launch points of the chief rays, from which rays are followed over the pupil; None: from the axis
            outward.
    """

    lens: Lens
    indices: Tensor
    tangents: Tensor
    vergence: float
    targets: Tensor
    paraxial: Tensor
    curved: bool
    chief: Tensor | None = None

    @property
    def start(self) -> Tensor:
        """(M, 2) launch points where the search begins [mm]."""
        return self.paraxial if self.chief is None else self.chief

    def part(self, selection: Tensor) -> "Aim":
        """Return the rays with the indices `selection`."""
        rays = {name: getattr(self, name)[selection] for name in ("tangents", "targets", "paraxial")}
        chief = None if self.chief is None else self.chief[selection]
        return replace(self, indices=self.indices[:, selection], chief=chief, **rays)

    def scaled(self, scale: Tensor) -> "Aim":
        """Return rays with targets times `scale` (M,), nearer to their chief ray, or, with tangents, to the axis."""
        names = ("tangents", "targets", "paraxial") if self.chief is None else ("targets",)
        return replace(self, **{name: scale[:, None] * getattr(self, name) for name in names})

    def predict(self, point: Tensor, before: Tensor, scale: Tensor) -> Tensor:
        """Predict launch points (M, 2) at `scale` (M, 1) from the solutions `point` at the scale `before`.

        Third-order aberrations predict x(s) = a s + b s^3 from the axis outward, with a from paraxial optics and b from
        the last solution; over the pupil x is linear in s.
        """
        started = before > 0
        if self.chief is not None:
            return self.chief + torch.where(started, (point - self.chief) * (scale / before), 0.0)
        b = torch.where(started, (point / before - self.paraxial) / before**2, 0.0)
        return self.paraxial * scale + b * scale**3


@dataclass(frozen=True)
class Solution:
    """Launch points of M rays, and the status of each ray.

    Attributes:
        point: (M, 2) launch points [mm]; for a ray that cannot be aimed, the launch point of the nearest aimed ray on
            the way to it.
        status, lost_at: (M,) as in `Rays`; for a ray that cannot be aimed the reason, MISSED at the stop if no other.
    """

    point: Tensor
    status: Tensor
    lost_at: Tensor


def inverse(matrices: Tensor) -> Tensor:
    """Invert matrices (..., 2, 2)."""
    a, b, c, d = matrices.flatten(-2).unbind(-1)
    return (torch.stack([d, -b, -c, a], -1) / (a * d - b * c)[..., None]).reshape(matrices.shape)


def newton(aim: Aim, guess: Tensor) -> tuple[Solution, Tensor]:
    """Solve for the launch points by Newton's iteration from `guess` (M, 2).

    A ray fails if a step does not halve its error, or if the determinant of its derivative is not positive. In paraxial
    optics it is positive; a point beyond a fold of the pupil is not the solution.

    Returns:
        Launch points with the statuses of failed rays, and (M,) whether each ray has converged to its solution.
    """
    tolerance = _TOLERANCE * float(aim.lens.thickness.abs().sum())
    point, converged = guess.clone(), torch.zeros(len(guess), dtype=torch.bool)
    status = torch.full((len(guess),), int(RayStatus.MISSED), dtype=torch.int8)
    lost_at = torch.full_like(status, aim.lens.stop)
    active, before = torch.arange(len(guess)), torch.full_like(guess[:, 0], torch.inf)
    for _ in range(_NEWTON_STEPS):
        part = aim.part(active)
        launched, tangents = (v[None, :, None] for v in (point[active], part.tangents))
        points, derivative, at = points_at_stop(aim.lens, launched, tangents, aim.vergence, part.indices, aim.curved)
        error, derivative, valid = points[0, :, 0] - part.targets, derivative[0, :, 0], at.valid[0, :, 0]
        size = error.norm(dim=-1)
        near = valid & (size <= tolerance)
        steady = valid & (torch.det(derivative) > 0) & (near | (size < 0.5 * before))
        converged[active] = near & steady
        status[active[~valid]], lost_at[active[~valid]] = at.status[0, ~valid, 0], at.lost_at[0, ~valid, 0]
        point[active[steady]] -= (inverse(derivative[steady]) @ error[steady, :, None])[..., 0]
        remaining = steady & ~near
        active, before = active[remaining], size[remaining]
        if not len(active):
            break
    return Solution(point, status, lost_at), converged


def follow(aim: Aim, guess: Tensor) -> Solution:
    """Solve for the launch points of all rays that have one.

    Newton's iteration begins at `guess` (M, 2). If it fails, the ray is followed outward: from the axis, with field and
    pupil point scaled by s from 0 to 1, or from its chief ray, with the pupil point scaled. A failed step is halved.
    """
    count = len(guess)
    reached, stride = guess.new_zeros(count), guess.new_ones(count)
    point = torch.zeros_like(guess)
    status = torch.zeros(count, dtype=torch.int8)
    lost_at = status - 1
    pending, start = torch.arange(count), guess
    while True:
        fraction = (reached[pending] + stride[pending]).clamp(max=1)
        solution, converged = newton(aim.part(pending).scaled(fraction), start)
        moved, stuck = pending[converged], pending[~converged]
        reached[moved], point[moved] = fraction[converged], solution.point[converged]
        status[stuck], lost_at[stuck] = solution.status[~converged], solution.lost_at[~converged]
        stride[stuck] /= 2
        pending = pending[(reached[pending] < 1) & (stride[pending] >= _SHORTEST)]
        if not len(pending):
            break
        s = reached[pending, None]
        start = aim.part(pending).predict(point[pending], s, (s + stride[pending, None]).clamp(max=1))
    aimed = reached == 1
    status[aimed], lost_at[aimed] = int(RayStatus.OK), -1
    return Solution(point, status, lost_at)
