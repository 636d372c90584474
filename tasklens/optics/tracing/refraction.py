"""Refraction of a block of rays, with derivatives in reverse and in forward mode.

A ray has the position P = (x, y, z), z from the vertex, the direction D = (l, m, n) and the optical path. It meets the
surface z = s(u) at P' = P + t D, and leaves with the direction D':

    t:   z + t n = s(u),  u = x'^2 + y'^2                         (intersection)
    e  = -2 ds/du, so that (e x', e y', 1) is the normal;  h = x' l + y' m,  q = n + e h,  g^2 = 1 + e^2 u
    b  = (R - mu q) / g^2,  R^2 = g^2 (1 - mu^2) + mu^2 q^2,  mu = n_before / n_behind
    D' = mu D + b (e x', e y', 1)                                 (Snell's law)

s(u) = c u / (1 + sqrt(1 - (1 + k) c^2 u)) + sum_j alpha_2j u^j. Derivatives do not use the iteration for t: by the
implicit function theorem q dt = ds - dz - t dn - e (x', y').(dx + t dl, dy + t dm), where ds is the change of the sag
by the surface's own parameters. `surface` implements the same in plain autograd, and the tests compare the two.
"""

import math

from tasklens.optics.aspheres import EDGE
from tasklens.optics.rays import GRAZING
from tasklens.optics.tracing.block import (
    BENDING,
    BLOCK,
    CURVATURE,
    CURVING,
    GOES_ON,
    INDEX,
    L_OUT,
    LIMIT,
    M_OUT,
    MU,
    N_OUT,
    PASSES,
    PATH,
    POWER,
    SLOPE,
    VALUE,
    B,
    E,
    L,
    M,
    N,
    T,
    U,
    W,
    X,
    Y,
    Z,
    add,
    inlined,
)


@inlined
def to_surface(s):
    """Move rays by t."""
    for i in range(BLOCK):
        t = s[T + i]
        s[PATH + i] += s[INDEX + i] * t
        x, y = s[X + i] + t * s[L + i], s[Y + i] + t * s[M + i]
        s[X + i], s[Y + i] = x, y
        s[Z + i] += t * s[N + i]
        s[U + i] = x * x + y * y


@inlined
def refract(s, surface):
    """Refract rays at a surface; the row SLOPE must be filled. Returns the number of lost rays."""
    number = s.dtype.type
    one, edge, grazing = number(1), number(EDGE), number(GRAZING)
    c, bending, limit = surface[CURVATURE], surface[BENDING], surface[LIMIT]
    lost = 0
    for i in range(BLOCK):
        x, y, l, m, n, mu, u = s[X + i], s[Y + i], s[L + i], s[M + i], s[N + i], s[MU + i], s[U + i]
        argument = one - bending * u
        w = one / math.sqrt(argument if argument > edge else edge)
        e = -(s[SLOPE + i] + s[SLOPE + i]) - c * w
        q = n + e * (x * l + y * m)
        g2 = one + e * e * u
        squared = (one - mu * mu) * g2 + mu * mu * q * q
        passes = squared > grazing * grazing
        b = (math.sqrt(squared if passes else one) - mu * q) / g2
        n = mu * n + b
        s[L_OUT + i], s[M_OUT + i], s[N_OUT + i] = mu * l + b * e * x, mu * m + b * e * y, n
        s[W + i], s[E + i], s[B + i] = w, e, b
        passes = passes & (n > grazing)
        s[PASSES + i] = one if u <= limit else -one
        s[GOES_ON + i] = one if passes else -one
        lost += not (passes & (u <= limit))
    return lost


@inlined
def refract_vjp(s, g, surface):
    """Propagate the gradient g of the rays behind a surface back to those before it.

    Rows VALUE, SLOPE and W of g become the gradients of sag / u, of ds/du and of mu.
    """
    number = s.dtype.type
    one, half = number(1), number(0.5)
    conic = half * half * surface[BENDING] * surface[CURVATURE]
    for i in range(BLOCK):
        x, y, l, m, n, t, mu, u = s[X + i], s[Y + i], s[L + i], s[M + i], s[N + i], s[T + i], s[MU + i], s[U + i]
        w, e, b = s[W + i], s[E + i], s[B + i]
        b_x, b_y, b_z, b_l, b_m, b_n = g[X + i], g[Y + i], g[Z + i], g[L + i], g[M + i], g[N + i]
        h = x * l + y * m
        q = n + e * h
        g2 = one + e * e * u
        inverse_root = one / (b * g2 + mu * q)
        # D' = mu D + b e P',  n' = mu n + b
        b_be = b_l * x + b_m * y
        b_b = (b_n + e * b_be) / g2
        turn = mu * q * inverse_root
        g[W + i] = b_n * n + b_l * l + b_m * m + b_b * (turn * q - mu * g2 * inverse_root - q)
        b_x += b * e * b_l
        b_y += b * e * b_m
        # b = (R - mu q) / g^2,  q = n + e h,  g^2 = 1 + e^2 u
        b_q = mu * b_b * (turn - one)
        b_g2 = b_b * ((one - mu * mu) * inverse_root - b - b) * e  # times 2 e
        b_h = e * b_q
        b_slope = b * b_be + h * b_q + u * b_g2
        b_slope = -b_slope - b_slope
        b_l, b_m, b_n = b_h * x + mu * b_l, b_h * y + mu * b_m, b_q + mu * b_n
        # u = P'.P',  h = P'.D,  e = -2 ds/du
        curving = s[CURVING + i] + conic * w * w * w
        b_u = e * b_g2 + (b_slope + b_slope) * curving  # times 2
        b_x += b_h * l
        b_y += b_h * m
        # P' = P + t D and the intersection
        b_t = g[PATH + i] * s[INDEX + i] + b_z * n + b_u * h
        tau = (b_t + b_x * l + b_y * m) / q
        b_u -= tau * e
        b_x += b_u * x
        b_y += b_u * y
        b_z -= tau
        g[X + i], g[Y + i], g[Z + i] = b_x, b_y, b_z
        g[L + i], g[M + i], g[N + i] = b_l + t * b_x, b_m + t * b_y, b_n + t * b_z
        g[VALUE + i], g[SLOPE + i] = tau * u, b_slope


@inlined
def parameters_vjp(s, g, surface, total, orders):
    """Add the gradients of a surface's parameters to `total`: curvature, conic, and from column 3 on alpha."""
    number = s.dtype.type
    one, half = number(1), number(0.5)
    by_curvature, by_conic = number(0), number(0)
    for i in range(BLOCK):
        u, w, b_by_u, b_slope = s[U + i], s[W + i], g[VALUE + i], g[SLOPE + i]
        v = w / (one + w)  # 1 / (1 + sqrt(1 - (1 + k) c^2 u))
        cube = half * w * w * w
        by_curvature = add(by_curvature, b_by_u * w * v + b_slope * cube)
        by_conic = add(by_conic, u * (b_by_u * w * v * v + b_slope * cube))
        g[POWER + i] = one  # u^(j - 1)
    total[0] += by_curvature
    total[1] += by_conic * half * surface[CURVATURE] * surface[CURVATURE] * surface[CURVATURE]
    for j in range(orders):
        by_value, by_slope = number(0), number(0)
        for i in range(BLOCK):
            power = g[POWER + i]
            by_value = add(by_value, power * g[VALUE + i])
            by_slope = add(by_slope, power * g[SLOPE + i])
            g[POWER + i] = power * s[U + i]
        total[3 + j] += by_value + (j + 1) * by_slope


@inlined
def refract_jvp(s, d, surface):
    """Propagate small changes d of the rays before a surface to those behind it.

    Rows VALUE and SLOPE of s hold changes of sag / u and ds/du by the surface's asphere coefficients; rows MU, INDEX, W
    and E of d hold changes of mu, the index in front of the surface, the curvature and the conic.
    """
    number = s.dtype.type
    one, half = number(1), number(0.5)
    c = surface[CURVATURE]
    cube, conic = half * c * c * c, half * half * surface[BENDING] * c
    for i in range(BLOCK):
        x, y, l, m, n, t, mu, u = s[X + i], s[Y + i], s[L + i], s[M + i], s[N + i], s[T + i], s[MU + i], s[U + i]
        w, e, b = s[W + i], s[E + i], s[B + i]
        dl, dm, dn = d[L + i], d[M + i], d[N + i]
        h = x * l + y * m
        q = n + e * h
        g2 = one + e * e * u
        root = b * g2 + mu * q
        v = w / (one + w)  # 1 / (1 + sqrt(1 - (1 + k) c^2 u))
        dc, d_conic = d[W + i], cube * d[E + i]
        d_sag = u * (w * v * (dc + d_conic * u * v) + s[VALUE + i])
        d_slope = half * w * w * w * (dc + d_conic * u) + s[SLOPE + i]
        # P' = P + t D and the intersection
        dx, dy, dz = d[X + i] + t * dl, d[Y + i] + t * dm, d[Z + i] + t * dn
        dt = (d_sag - dz - e * (x * dx + y * dy)) / q
        dx, dy, dz = dx + dt * l, dy + dt * m, dz + dt * n
        # e, q, g^2, b
        du = x * dx + y * dy
        du += du
        de = d_slope + (s[CURVING + i] + conic * w * w * w) * du
        de = -de - de
        dq = dn + h * de + e * (x * dl + y * dm + l * dx + m * dy)
        d_g2 = e * (u * (de + de) + e * du)
        d_mu = d[MU + i]
        d_squared = half * (one - mu * mu) * d_g2 + mu * (mu * q * dq + d_mu * (q * q - g2))  # half of it
        db = (d_squared / root - mu * dq - q * d_mu - b * d_g2) / g2
        # D' = mu D + b (e P', 1)
        be, d_be = b * e, db * e + b * de
        d[X + i], d[Y + i], d[Z + i] = dx, dy, dz
        d[L + i] = mu * dl + d_mu * l + d_be * x + be * dx
        d[M + i] = mu * dm + d_mu * m + d_be * y + be * dy
        d[N + i] = mu * dn + d_mu * n + db
        d[PATH + i] += s[INDEX + i] * dt + d[INDEX + i] * t
