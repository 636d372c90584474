"""Ray aiming: launch points of rays that meet a stop inside the lens at target points, differentiable in the lens."""

from dataclasses import replace
from typing import Any

import torch
import torch.autograd.forward_ad as fwAD
from torch import Tensor

from tasklens.optics.analysis.bundles import solve_bundles
from tasklens.optics.analysis.continuation import inverse, points_at_stop, rays_at_stop, stop_is_curved
from tasklens.optics.analysis.object_points import rays_from_object
from tasklens.optics.lens import Lens
from tasklens.optics.rays import RayStatus

_ROUNDING = 16  # rounding error of a ray in single precision [machine epsilon]
_NUMBERS = ("curvature", "conic", "alpha", "thickness", "semi_diameter")


def stop_is_inside(lens: Lens) -> bool:
    """Return whether a refracting surface is in front of the stop; otherwise the stop is its own entrance pupil."""
    return any(i < lens.stop for i in lens.refracting_surfaces)


def aim(
    lens: Lens, tangents: Tensor, vergence: float, pupil: Tensor, indices: Tensor, entrance_pupil: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the launch points of rays that meet a stop inside the lens at `pupil` times its radius.

    A launch point x solves F(x, p) = r(x, p) - R P = 0, with the point r at which the ray meets the stop surface, the
    radius R of the stop, and the pupil point P. p are all parameters of F, including the tangents, which depend on the
    lens if the object is near. x* is computed without a graph. One more Newton step with a graph,
    x = x* - (dF/dx)^-1 F(x*, p), makes its derivatives exact by the implicit function theorem,
    dx/dp = -(dF/dx)^-1 dF/dp. Second derivatives are not exact.

    Args:
        lens: the lens. Its apertures are ignored, except the radius of the stop.
        tangents: (F, 2) direction tangents of the fields as seen from the first vertex.
        vergence: 1 / distance of the object from the first vertex [1/mm].
        pupil: (N, 2) points of the unit disc.
        indices: (S + 1, W) refractive indices.
        entrance_pupil: (2,) radius and position of the paraxial entrance pupil [mm], where the search begins.

    Returns:
        (F, W, N, 2) launch points [mm] on the first vertex plane in double precision, differentiable in the lens,
        `tangents`, `pupil` and `indices`; `status` and `lost_at` (F, W, N) as in `Rays`. A ray is lost if no launch
        point brings it to its pupil point. Its status is the reason, or MISSED at the stop; its launch point is that of
        the nearest aimed ray.
    """
    if lens.dtype != torch.float64:  # otherwise rays on the rim would not pass the stop
        pupil = pupil.double() * (1 - _ROUNDING * torch.finfo(lens.dtype).eps)
    lens = lens.double()
    numbers = [getattr(lens, name) for name in _NUMBERS]
    tangents, pupil, indices, entrance_pupil = (v.double() for v in (tangents, pupil, indices, entrance_pupil))
    differentiable = any(_carries_derivative(v) for v in (*numbers, tangents, pupil, indices))
    point, slope, status, lost_at = _Solve.apply(
        lens, differentiable, vergence, tangents, pupil, indices, entrance_pupil, *numbers
    )
    if differentiable:
        at = rays_at_stop(lens, rays_from_object(point, tangents[:, None, None], vergence), indices)
        error = torch.stack([at.x, at.y], -1) - pupil * lens.semi_diameter[lens.stop]
        aimed = ((status == RayStatus.OK) & at.valid)[..., None]
        point = point - torch.where(aimed, (slope @ error[..., None])[..., 0], 0.0)
    return point, status, lost_at


class _Solve(torch.autograd.Function):
    """Launch points x* of all rays and (dF/dx)^-1, which are constants in every kind of derivative."""

    @staticmethod
    def forward(  # type: ignore[override]
        lens: Lens,
        differentiable: bool,
        vergence: float,
        tangents: Tensor,
        pupil: Tensor,
        indices: Tensor,
        entrance_pupil: Tensor,
        *numbers: Tensor,
    ) -> tuple[Tensor, ...]:
        detached: dict[str, Any] = {name: value.detach() for name, value in zip(_NUMBERS, numbers, strict=True)}
        lens = replace(lens, **detached)
        tangents, pupil, indices, entrance_pupil = (v.detach() for v in (tangents, pupil, indices, entrance_pupil))
        solution = solve_bundles(lens, tangents, vergence, pupil, indices, entrance_pupil)
        size = (len(tangents), indices.shape[1], len(pupil))
        point, status, lost_at = (
            solution.point.reshape(*size, 2),
            solution.status.reshape(size),
            solution.lost_at.reshape(size),
        )
        slope = torch.zeros(0, dtype=torch.float64)
        if differentiable:
            along, curved = tangents[:, None, None], stop_is_curved(lens)
            _, derivative, _ = points_at_stop(lens, point, along, vergence, indices, curved)
            slope = torch.where((status == RayStatus.OK)[..., None, None], inverse(derivative), 0.0)
        return point, slope, status, lost_at

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def backward(ctx: Any, *_: Tensor | None) -> tuple[None, ...]:
        return (None,) * (7 + len(_NUMBERS))

    @staticmethod
    def jvp(ctx: Any, *_: Tensor | None) -> tuple[None, ...]:
        return (None,) * 4


def _carries_derivative(values: Tensor) -> bool:
    return (torch.is_grad_enabled() and values.requires_grad) or fwAD.unpack_dual(values).tangent is not None
