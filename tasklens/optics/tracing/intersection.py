"""Intersection of rays with a surface: t with z + t n = s(u), u = (x + t l)^2 + (y + t m)^2."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from tasklens.optics.aspheres import EDGE
from tasklens.optics.rays import GRAZING

_NEWTON_STEPS = 8  # for all rays together; what has not converged then is taken aside
_CAREFUL_STEPS = 30
_STEEP = 1e-3  # smallest derivative of the distance to a surface along a ray that the careful iteration divides by
_STRIDE = 2.0  # longest Newton step [mm]: without a limit a ray may leave for good


@dataclass(frozen=True)
class PreparedSurface:
    """Coefficients of one surface, prepared for evaluation.

    Attributes:
        curvature: c [1/mm].
        minus_kappa: -(1 + k) c^2 for the conic k.
        columns: M of (2, 1, 1, 1), the coefficients of u^(j - 1) in sag / u and in d sag / du: alpha_2j and j alpha_2j.
        slopes: M of (1, 1, 1), the second of each.
        curving: (M - 1,) those in d^2 sag / du^2: (j + 1) j alpha_(2j + 2).
        orders: (M,) 1 .. M.
        one: 1, 0-dim.
        plane: whether it is one.
    """

    curvature: float
    minus_kappa: float
    columns: tuple[Tensor, ...]
    slopes: tuple[Tensor, ...]
    curving: Tensor
    orders: Tensor
    one: Tensor
    plane: bool


class Shape(NamedTuple):
    """A surface at squared radii u: sag s, ds / du, w = 1 / sqrt(1 - (1 + k) c^2 u), and the argument of that root."""

    sag: Tensor
    slope: Tensor
    w: Tensor
    argument: Tensor


def surfaces(curvature: Tensor, conic: Tensor, alpha: Tensor) -> list[PreparedSurface]:
    """Prepare S surfaces from their coefficients, (S,), (S,) and (S, M)."""
    one = torch.ones((), dtype=curvature.dtype, device=curvature.device)
    orders = torch.arange(1, alpha.shape[1] + 1, dtype=alpha.dtype, device=alpha.device)
    curving = alpha[:, 1:] * (orders[1:] * (orders[1:] - 1))
    columns = torch.stack([alpha, alpha * orders], 1)[..., None, None, None]
    planes = (curvature == 0) & (alpha == 0).all(1)
    numbers = torch.stack([curvature, -(1 + conic) * curvature**2, planes], 1).tolist()
    return [
        PreparedSurface(c, minus_kappa, column.unbind(1), column[1].unbind(), curve, orders, one, bool(plane))
        for (c, minus_kappa, plane), column, curve in zip(numbers, columns.unbind(), curving.unbind(), strict=True)
    ]


def shape(u: Tensor, surface: PreparedSurface) -> Shape:
    """Evaluate a surface at u = r^2, as `aspheres.sag` but without a graph and in few operations."""
    w, safe, argument = _root(u, surface)
    conic = torch.addcmul(surface.one, safe, w)  # 1 + sqrt(argument)
    if not surface.columns:
        return Shape(u * surface.curvature / conic, (0.5 * surface.curvature) * w, w, argument)
    by_u, slope = _polynomial(u, surface.columns)
    sag = torch.addcdiv(by_u, surface.one, conic, value=surface.curvature).mul_(u)
    return Shape(sag, torch.add(slope, w, alpha=0.5 * surface.curvature), w, argument)


def slope(u: Tensor, surface: PreparedSurface) -> tuple[Tensor, Tensor]:
    """Compute ds / du and w of `shape` alone."""
    w, *_ = _root(u, surface)
    conic = (0.5 * surface.curvature) * w
    return (conic.add_(_polynomial(u, surface.slopes)) if surface.slopes else conic), w


def _root(u: Tensor, surface: PreparedSurface) -> tuple[Tensor, Tensor, Tensor]:
    """Compute 1 / sqrt(1 - (1 + k) c^2 u), the clamped argument of the root, and the argument itself."""
    argument = torch.add(surface.one, u, alpha=surface.minus_kappa)
    safe = argument.clamp(min=EDGE) if surface.minus_kappa < 0 else argument
    return torch.rsqrt(safe), safe, argument


def _polynomial(u: Tensor, coefficients: tuple[Tensor, ...]) -> Tensor:
    """Sum coefficients times u^(j - 1) by Horner's rule, in place: allocating costs as much as multiplying."""
    *lower, last = coefficients
    value = last.expand(*last.shape[:-3], *u.shape)
    for k, coefficient in enumerate(reversed(lower)):
        value = torch.addcmul(coefficient, value, u, out=value if k else None)
    return value


def distance(
    x: Tensor, y: Tensor, l: Tensor, m: Tensor, n: Tensor, surface: PreparedSurface
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Compute the distance t [mm] of rays from (x, y) on the vertex plane to the surface, and which rays meet it.

    Newton's iteration, on all rays together: a step below the square root of the precision leaves an error below the
    precision. Rays that have not converged, have left the conic, graze, or come through the surface from behind are
    taken aside and tried again with care.

    Returns:
        t, u and h at the surface, zero for a ray that does not meet it; a mask of those that do, or None when all do.
    """
    tolerance = torch.finfo(n.dtype).eps ** 0.5
    a, b = torch.addcmul(x * x, y, y), torch.addcmul(x * l, y, m)
    c = torch.addcmul(surface.one, n, n, value=-1)  # u = a + 2 b t + c t^2
    found = shape(a, surface)
    derivative = torch.addcmul(n, found.slope, b, value=-2)
    step = torch.div(found.sag, derivative).clamp_(-_STRIDE, _STRIDE)
    t = step.clone()
    for _ in range(_NEWTON_STEPS):
        least, most = torch.aminmax(step)
        worst = max(-float(least), float(most))
        h = torch.addcmul(b, t, c)
        u = torch.addcmul(a, t, b + h)
        if worst <= tolerance:
            break
        found = shape(u, surface)
        derivative = torch.addcmul(n, found.slope, h, value=-2)
        step = torch.addcmul(found.sag, t, n, value=-1).div_(derivative).clamp_(-_STRIDE, _STRIDE)
        t += step
    inside = surface.minus_kappa >= 0 or float(found.argument.min()) > EDGE
    if worst <= tolerance and inside and float(derivative.min()) > GRAZING:
        return t, u, h, None
    met = (step.abs() <= tolerance) & (found.argument > EDGE) & (derivative > GRAZING)
    astray = ~met
    few = (v[astray][None, None] for v in (a, b, c, n))
    t[astray], met[astray] = (v[0, 0] for v in _careful_distance(*few, surface, tolerance))
    h = torch.addcmul(b, t, c)
    u = torch.addcmul(a, t, b + h)
    if bool(met.all()):
        return t, u, h, None
    return *(torch.where(met, v, 0.0) for v in (t, u, h)), met


def _careful_distance(
    a: Tensor, b: Tensor, c: Tensor, n: Tensor, surface: PreparedSurface, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Compute `distance` for difficult rays by bounded Newton steps, from the base conic, then from the plane."""
    # the conic: c (r^2 + (1 + k) z^2) = 2 z with z = t n
    along = n - surface.curvature * b
    discriminant = along * along - a * (surface.curvature * surface.curvature * c - surface.minus_kappa * n * n)
    root = along + torch.sqrt(discriminant.clamp(min=0))
    on_conic = (discriminant > 0) & (root > GRAZING)
    conic = torch.where(on_conic, surface.curvature * a / root.clamp(min=GRAZING), 0.0)
    best, ever = torch.zeros_like(n), torch.zeros_like(n, dtype=torch.bool)
    for t in (conic, torch.zeros_like(n)):
        for _ in range(_CAREFUL_STEPS):
            half = torch.addcmul(b, t, c)
            found = shape(torch.addcmul(a, t, b + half), surface)
            derivative = torch.addcmul(n, found.slope, half, value=-2)
            least = torch.copysign(derivative.abs().clamp(min=_STEEP), derivative)
            step = torch.addcmul(found.sag, t, n, value=-1) / least
            met = (step.abs() <= tolerance) & (found.argument > EDGE) & (derivative > GRAZING)
            t = t + step.clamp(-_STRIDE, _STRIDE)
        best = torch.where(~ever & met, t, best)
        ever = ever | met
    return best, ever
