"""Refraction at a surface, with hand-written forward and reverse derivatives.

A ray has the transverse position P = (x, y) and direction D = (l, m), z from the vertex, and n. It meets the surface
z = s(u) at P' = P + t D and leaves with D', n':

    t:   z + t n = s(u),  u = P'.P'                               (intersection)
    e  = -2 ds/du, so that (e P', 1) is the normal;  h = P'.D,  q = n + e h,  g^2 = 1 + e^2 u
    b  = (R - mu q) / g^2,  R^2 = g^2 (1 - mu^2) + mu^2 q^2,  mu = n_before / n_behind
    D' = mu D + b e P',  n' = mu n + b                            (Snell's law)

`refract_jvp` carries small changes forward through these lines, `refract_vjp` carries gradients back. t needs no
derivative of its iteration: by the implicit function theorem q dt = ds - dz - t dn - e P'.(dP + t dD), where ds is the
change of the sag by the surface's own parameters.

Rays have the shape (F, W, N), mu (W, 1). The code is plain arithmetic in as few passes over the rays as we found.
`surface` states the same in a few lines of autograd, and the tests compare the two.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from tasklens.optics.rays import GRAZING
from tasklens.optics.tracing.intersection import PreparedSurface, slope


class RayState(NamedTuple):
    """Rays: position, z from a vertex, and direction cosines; or a change or gradient of them."""

    x: Tensor
    y: Tensor
    z: Tensor
    l: Tensor
    m: Tensor
    n: Tensor


class Refraction(NamedTuple):
    """Intermediate values of `refract` for its derivatives, named as in the equations above."""

    x: Tensor
    y: Tensor
    l: Tensor
    m: Tensor
    n: Tensor
    t: Tensor
    mu: Tensor
    u: Tensor
    w: Tensor
    e: Tensor
    h: Tensor
    q: Tensor
    g2: Tensor
    inverse_root: Tensor
    b: Tensor


def refract(
    at: RayState, t: Tensor, u: Tensor, h: Tensor, mu: Tensor, surface: PreparedSurface
) -> tuple[RayState, Tensor, Refraction]:
    """Refract rays at their intersections (x, y, z) with the surface; t, u, h and mu as in the equations above.

    Returns:
        the rays behind it, z from its vertex; R^2, not positive in total reflection, when the ray behind means nothing
        but is finite; the Refraction.
    """
    x, y, z, l, m, n = at
    e, w = slope(u, surface)
    e *= -2
    q = torch.addcmul(n, e, h)
    g2 = torch.addcmul(surface.one, e * e, u)
    mu_q = mu * q
    squared = torch.addcmul((1 - mu * mu) * g2, mu_q, mu_q)
    safe = squared.clamp(min=GRAZING**2)
    inverse_root = torch.rsqrt(safe)
    b = torch.addcmul(mu_q, safe, inverse_root, value=-1) / -g2
    be = b * e
    behind = RayState(x, y, z, torch.addcmul(mu * l, be, x), torch.addcmul(mu * m, be, y), torch.addcmul(b, mu, n))
    return behind, squared, Refraction(x, y, l, m, n, t, mu, u, w, e, h, q, g2, inverse_root, b)


def refract_jvp(
    before: RayState,
    mu_change: Tensor,
    parameters: tuple[Tensor, Tensor, Tensor],
    refraction: Refraction,
    surface: PreparedSurface,
) -> tuple[RayState, Tensor]:
    """Propagate small changes of the rays before a surface, and of the surface, to the rays behind it.

    Args:
        before: changes of the rays before it, z from its vertex.
        mu_change: change of mu.
        parameters: changes of curvature and conic, which broadcast with the rays, and of alpha (..., M).

    Returns:
        changes of the rays behind it, and of t.
    """
    x, y, l, m, n, t, mu, u, w, e, h, q, g2, inverse_root, b = refraction
    dx, dy, dz, dl, dm, dn = before
    dc, dk, da = parameters
    v = w / (1 + w)  # 1 / (1 + sqrt(1 - (1 + k) c^2 u))
    powers = _powers(u, len(surface.columns))
    conic = 0.5 * _cubed(surface.curvature) * dk
    d_sag, d_slope = u * w * v * (dc + conic * u * v), 0.5 * w**3 * (dc + conic * u)
    if powers is not None:
        size = (*da.shape[:-1], *u.shape)
        d_sag = d_sag + u * (da @ powers).reshape(size)
        d_slope = d_slope + ((surface.orders * da) @ powers).reshape(size)
    # P' = P + t D and the intersection
    dx, dy, dz = dx + t * dl, dy + t * dm, dz + t * dn
    dt = (d_sag - dz - e * (x * dx + y * dy)) / q
    dx, dy, dz = dx + dt * l, dy + dt * m, dz + dt * n
    # e, h, q, g^2
    du = 2 * (x * dx + y * dy)
    de = -2 * (d_slope + _curving(w, surface, powers) * du)
    dq = dn + h * de + e * (x * dl + y * dm + l * dx + m * dy)
    d_g2 = e * (2 * u * de + e * du)
    # b, D', n'
    d_squared = (1 - mu * mu) * d_g2 + 2 * mu * (mu * q * dq + mu_change * (q * q - g2))
    db = (0.5 * d_squared * inverse_root - mu * dq - q * mu_change - b * d_g2) / g2
    be, d_be = b * e, db * e + b * de
    dl = mu * dl + mu_change * l + d_be * x + be * dx
    dm = mu * dm + mu_change * m + d_be * y + be * dy
    return RayState(dx, dy, dz, dl, dm, mu * dn + mu_change * n + db), dt


def refract_vjp(
    after: RayState, along: Tensor, refraction: Refraction, surface: PreparedSurface, index: bool
) -> tuple[RayState, tuple[Tensor, Tensor, Tensor], Tensor | None]:
    """Propagate the gradient of the rays behind a surface back to the rays before it, and to the surface.

    Args:
        after: gradient at the rays behind it, z from its vertex.
        along: gradient at t from elsewhere (the optical path).
        index: whether the gradient at mu is wanted.

    Returns:
        gradient at the rays before it, z from the same vertex; at curvature and conic, 0-dim, and at alpha (M,);
        at mu, of the rays' shape, or None.
    """
    x, y, l, m, n, t, mu, u, w, e, h, q, g2, inverse_root, b = refraction
    b_x, b_y, b_z, b_l, b_m, b_n = after
    # D' = mu D + b e P,  n' = mu n + b
    b_be, be = torch.addcmul(b_l * x, b_m, y), b * e
    b_b = torch.addcmul(b_n, e, b_be) / g2  # the gradient at b, over g^2
    turn = mu * q * inverse_root
    b_mu = None
    if index:
        b_mu = torch.addcmul(torch.addcmul(b_n * n, b_l, l), b_m, m) + b_b * (turn * q - mu * g2 * inverse_root - q)
    b_x, b_y = torch.addcmul(b_x, be, b_l), torch.addcmul(b_y, be, b_m)
    # b = (R - mu q) / g^2,  q = n + e h,  g^2 = 1 + e^2 u
    b_q = mu * b_b * (turn - 1)
    b_g2 = b_b * torch.addcmul(-2 * b, inverse_root, 1 - mu * mu) * e  # times 2 e
    b_h = e * b_q
    b_slope = -2 * torch.addcmul(torch.addcmul(b * b_be, h, b_q), u, b_g2)
    b_l, b_m, b_n = torch.addcmul(b_h * x, mu, b_l), torch.addcmul(b_h * y, mu, b_m), torch.addcmul(b_q, mu, b_n)
    # u = P.P,  h = P.D,  e = -2 ds/du
    powers = _powers(u, len(surface.columns))
    b_u = torch.addcmul(e * b_g2, b_slope, _curving(w, surface, powers), value=2)  # times 2
    b_x, b_y = torch.addcmul(b_x, b_h, l), torch.addcmul(b_y, b_h, m)
    # P' = P + t D and the intersection
    b_t = torch.addcmul(torch.addcmul(along, b_z, n), b_u, h)
    tau = torch.addcmul(torch.addcmul(b_t, b_x, l), b_y, m) / q
    b_u = torch.addcmul(b_u, tau, e, value=-1)
    b_x, b_y, b_z = torch.addcmul(b_x, b_u, x), torch.addcmul(b_y, b_u, y), b_z - tau
    b_l, b_m, b_n = torch.addcmul(b_l, t, b_x), torch.addcmul(b_m, t, b_y), torch.addcmul(b_n, t, b_z)
    return RayState(b_x, b_y, b_z, b_l, b_m, b_n), _at_surface(tau * u, b_slope, u, w, powers, surface), b_mu


def _at_surface(
    b_by_u: Tensor, b_slope: Tensor, u: Tensor, w: Tensor, powers: Tensor | None, surface: PreparedSurface
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the gradients of curvature, conic and alpha from those of the sag (times u) and the slope."""
    b_by_u, b_slope, u, w = (v.flatten() for v in (b_by_u, b_slope, u, w))
    cube, v = w * w * w, w / (1 + w)  # v = 1 / (1 + sqrt(1 - (1 + k) c^2 u))
    wv = w * v
    b_curvature = torch.dot(b_by_u, wv) + 0.5 * torch.dot(b_slope, cube)
    b_conic = (2 * torch.dot(b_by_u * u, wv * v) + torch.dot(b_slope * u, cube)) * (_cubed(surface.curvature) / 4)
    if powers is None:
        return b_curvature, b_conic, surface.orders
    sums = powers @ torch.stack([b_by_u, b_slope]).T
    return b_curvature, b_conic, torch.addcmul(sums[:, 0], surface.orders, sums[:, 1])


def _cubed(curvature: float) -> float:
    return curvature * curvature * curvature  # ** would raise where a design has diverged


def _curving(w: Tensor, surface: PreparedSurface, powers: Tensor | None) -> Tensor:
    """Compute d^2 s / du^2."""
    conic = w * w * w * (-0.25 * surface.minus_kappa * surface.curvature)
    if powers is None or len(powers) < 2:
        return conic
    return torch.addmv(conic.flatten(), powers[:-1].T, surface.curving).reshape(w.shape)


def _powers(u: Tensor, count: int) -> Tensor | None:
    """Return the rows u^0 .. u^(count - 1), (count, F W N), or None for count 0."""
    if count == 0:
        return None
    u = u.flatten()
    rows = [torch.ones_like(u), u]
    while len(rows) < count:
        rows.append(rows[-1] * u)
    return torch.stack(rows[:count])
