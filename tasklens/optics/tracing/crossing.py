"""First crossing of rays and a surface: t with z + t n = s(u), u = (x + t l)^2 + (y + t m)^2."""

import math

import numpy

from tasklens.optics.aspheres import EDGE
from tasklens.optics.rays import GRAZING, RayStatus
from tasklens.optics.tracing.block import (
    A0,
    B0,
    BENDING,
    BLOCK,
    C0,
    CURVATURE,
    CURVINGS,
    GENTLE,
    LIMIT,
    MEETS,
    SLOPE,
    SLOPES,
    THICKNESS,
    VALUE,
    VALUES,
    WIDEST,
    L,
    M,
    N,
    T,
    U,
    X,
    Y,
    Z,
    entry,
    horner,
    inlined,
)

# A profile of slopes: bounds of |ds/dr| in cells of the radius, the end of the last cell, and the squared radius up to
# which the bounds do not exceed 1
CELLS = 32
REACH, GENTLE_HERE = CELLS, CELLS + 1
PROFILE = CELLS + 2
_NEWTON_STEPS = 8  # for all rays of a block; rays that have not converged are then processed one by one
_SAFE_STEPS = 400
_SAFE_TOLERANCE = 1e-9  # [mm]; the error after a step is of the order of its square, and one more follows
_FAR = 1e7  # [mm] largest height at which a ray meets a surface
_MISSED = int(RayStatus.MISSED)


@inlined
def intersect(s, surface, polynomials, slopes, lost_status):
    """Fill the row T with the distances to the surface; mark rays that miss it in `lost_status`, with distance 0.

    `slopes` is a profile of slopes, filled on demand. Returns the number of rays that miss the surface.
    """
    if surface[CURVATURE] == 0 and surface[GENTLE] == math.inf:  # a plane
        for i in range(BLOCK):
            s[T + i] = -s[Z + i] / s[N + i]
        return 0
    missed = 0
    for i in range(BLOCK if _newton(s, surface, polynomials, slopes) > 0 else 0):
        n, r = s[N + i], math.sqrt(s[WIDEST + i])
        if s[MEETS + i] > 0 and 0 < r < _FAR:
            if not r < slopes[REACH]:
                _fill_slopes(slopes, 1.25 * r, surface, polynomials[VALUES])
            steepest = slopes[int(r / slopes[REACH] * CELLS)]
            if steepest * steepest * s[C0 + i] < n * n:
                continue
        t = first_crossing(s[X + i], s[Y + i], s[Z + i], s[L + i], s[M + i], n, surface, polynomials[VALUES])
        if math.isnan(t):
            lost_status[i] = _MISSED
            missed += 1
            t = 0.0
        s[T + i] = t
    return missed


@inlined
def _newton(s, surface, polynomials, slopes):
    """Move the rays of a block by Newton's method from the vertex plane to the surface.

    F(t) = z + t n - s(u) = 0. The crossing is the first one if F' > 0 on the whole way from the ray's last point:
    F' = n - 2 ds/du h, where |h| <= r sin i for the angle i to the axis, and 2 r ds/du is the slope of the surface.

    Returns the number of rays for which this does not prove that they meet the surface, and at their first crossing.
    """
    number = s.dtype.type
    zero, one, edge, grazing = number(0), number(1), number(EDGE), number(GRAZING)
    c, bending = surface[CURVATURE], surface[BENDING]
    gentle = max(surface[GENTLE], number(slopes[GENTLE_HERE]))
    tolerance = number(math.sqrt(numpy.finfo(s.dtype).eps))
    for i in range(BLOCK):
        l, m, n = s[L + i], s[M + i], s[N + i]
        t = s[Z + i] / n
        x, y = s[X + i] - t * l, s[Y + i] - t * m
        s[A0 + i] = x * x + y * y
        s[B0 + i] = x * l + y * m
        s[C0 + i] = one - n * n
        s[U + i] = s[A0 + i]
        s[T + i] = zero
    uncertain = 0
    for _ in range(_NEWTON_STEPS):
        horner(s, VALUE, polynomials[VALUES])
        horner(s, SLOPE, polynomials[SLOPES])
        pending = 0
        uncertain = 0
        for i in range(BLOCK):
            u, t, n, b0, c0 = s[U + i], s[T + i], s[N + i], s[B0 + i], s[C0 + i]
            h = b0 + t * c0
            argument = one - bending * u
            root = math.sqrt(argument if argument > edge else edge)
            derivative = root * (n - (s[SLOPE + i] + s[SLOPE + i]) * h) - c * h  # F' root
            step = root * ((u * s[VALUE + i] - t * n) * (one + root) + c * u) / ((one + root) * derivative)
            t += step
            u = s[A0 + i] + t * (b0 + b0 + t * c0)
            s[T + i] = t
            s[U + i] = u
            last = s[X + i] * s[X + i] + s[Y + i] * s[Y + i]
            widest = u if u > last else last
            converged = abs(step) <= tolerance * derivative  # the error is F'' step^2 / (2 F')
            meets = converged & (argument > edge) & (derivative > grazing * root)
            s[MEETS + i] = one if meets else zero
            s[WIDEST + i] = widest
            pending += not converged
            uncertain += not (meets & (widest < gentle) & (c0 < n * n))
        if pending == 0:
            break
    for i in range(BLOCK):
        s[T + i] -= s[Z + i] / s[N + i]
    return uncertain


@inlined
def first_crossing(x, y, z, l, m, n, surface, alpha):
    """Return the distance t along a ray to its first crossing of a surface, NaN if there is none.

    A ray in front of the surface goes forward, one behind it backward, to the first crossing. Steps never pass it: with
    |F''| <= B on the next D mm, |F| cannot vanish before 2 |F| / (F' + sqrt(F'^2 + 2 B |F|)), where F' is the
    derivative towards the surface. For small |F| this is Newton's step. A ray without a crossing reaches the edge of
    the surface, 1 - (1 + k) c^2 u = 0; this proves that there is no crossing.
    """
    x, y, z = numpy.float64(x), numpy.float64(y), numpy.float64(z)
    l, m, n = numpy.float64(l), numpy.float64(m), numpy.float64(n)
    c, bending = numpy.float64(surface[CURVATURE]), numpy.float64(surface[BENDING])
    u_end = min((1 - EDGE) / bending, _FAR * _FAR) if bending > 0 else _FAR * _FAR
    u, h, c0 = x * x + y * y, x * l + y * m, l * l + m * m
    t = 0.0
    if not u < u_end:  # to the edge
        square = h * h - c0 * (u - u_end)
        if not square > 0:
            return math.nan
        t = -(u - u_end) / (h + math.copysign(math.sqrt(square), h))
        u, h = u_end, h + t * c0
    sag, slope, _, _ = _bounded(u, u, c, bending, alpha)
    side = 1.0 if z + t * n <= sag else -1.0
    if t * side < 0:
        return math.nan  # at the edge the ray is already past the surface
    window = 1.0
    for _ in range(_SAFE_STEPS):
        sag, slope, _, _ = _bounded(u, u, c, bending, alpha)
        gap = side * (sag - z - t * n)
        if gap < 0:  # by rounding
            gap = 0.0
        derivative = n - 2 * slope * h
        away, root = side * h, math.sqrt(h * h + c0 * (u_end - u))
        way_out = (u_end - u) / (away + root) if away >= 0 else (root - away) / c0
        window = min(window, 0.75 * way_out)
        u_window, h_window = u + side * window * (2 * h + side * window * c0), h + side * window * c0
        _, _, steepest, most = _bounded(u, max(u, u_window), c, bending, alpha)
        bound = 4 * most * max(h * h, h_window * h_window) + 2 * steepest * c0
        step = 2 * gap / (derivative + math.sqrt(derivative * derivative + 2 * bound * gap))
        if not step >= 0:  # 0 / 0: on the surface and along it
            return math.nan
        if step <= window and step <= _SAFE_TOLERANCE:
            t += side * gap / derivative
            return t if derivative > GRAZING else math.nan
        if way_out <= _SAFE_TOLERANCE:
            return math.nan
        t += side * min(step, window)
        window = 2 * min(step, window)
        px, py = x + t * l, y + t * m
        u, h = px * px + py * py, px * l + py * m
    return math.nan


@inlined
def _bounded(u, u_most, c, bending, alpha):
    """Return sag and ds/du at u, and bounds of |ds/du| and |d^2 s/du^2| up to u_most."""
    root = math.sqrt(max(1 - bending * u, EDGE))
    w = 1 / math.sqrt(max(min(1 - bending * u_most, 1.0), EDGE))
    value, slope, steepest, most = 0.0, 0.0, 0.0, 0.0
    for j in range(len(alpha), 0, -1):
        a = numpy.float64(alpha[j - 1])
        slope = slope * u + value
        value = value * u + a
        steepest = steepest * u_most + j * abs(a)
        if j > 1:
            most = most * u_most + j * (j - 1) * abs(a)
    sag = c * u / (1 + root) + u * value
    slope = 0.5 * c / root + slope * u + value
    return sag, slope, 0.5 * abs(c) * w + steepest, 0.25 * abs(c * bending) * w * w * w + most


@inlined
def _fill_slopes(slopes, r_most, surface, alpha):
    """Fill a profile of slopes, up to the radius r_most.

    In a cell of width w a function is at most w^2 / 8 max |f''| above its values at the ends; here f = ds/dr.
    """
    slopes[REACH], slopes[GENTLE_HERE] = r_most, 0.0
    width, steepest, inner = r_most / CELLS, 0.0, 0.0
    c, bending = numpy.float64(surface[CURVATURE]), numpy.float64(surface[BENDING])
    for k in range(CELLS):
        r = (k + 1) * width
        u = r * r
        if bending * u >= 1 - EDGE:
            slopes[k:CELLS] = math.inf
            return
        second, third = 0.0, 0.0
        for j in range(len(alpha), 1, -1):
            a = j * (j - 1) * abs(numpy.float64(alpha[j - 1]))
            second = second * u + a
            if j > 2:
                third = third * u + (j - 2) * a
        w = 1 / math.sqrt(max(min(1 - bending * u, 1.0), EDGE))
        second += 0.25 * abs(c * bending) * w**3
        third += 0.375 * abs(c) * bending * bending * w**5
        outer = abs(2 * r * _bounded(u, u, c, bending, alpha)[1])
        steepest = max(steepest, max(inner, outer) + width * width / 8 * (12 * r * second + 8 * r * u * third))
        slopes[k], inner = steepest, outer
        if steepest <= 1:
            slopes[GENTLE_HERE] = u


@entry
def prepare(curvature, conic, thickness, alpha, limit, surfaces, polynomials):
    """Fill the table of surfaces and their polynomials; the polynomials must be zero before the call."""
    for k in range(len(surfaces)):
        surface, polynomial = surfaces[k], polynomials[k]
        surface[CURVATURE], surface[THICKNESS], surface[LIMIT] = curvature[k], thickness[k], limit[k]
        surface[BENDING] = (1 + conic[k]) * curvature[k] * curvature[k]
        for j in range(alpha.shape[1]):
            polynomial[VALUES, j], polynomial[SLOPES, j] = alpha[k, j], (j + 1) * alpha[k, j]
            if j > 0:
                polynomial[CURVINGS, j - 1] = j * (j + 1) * alpha[k, j]
        low, high = 0.0, 1.0
        while high < 1e8 and _steepest(high, surface, polynomial[VALUES]) <= 1:
            low, high = high, 2 * high
        for _ in range(12):
            middle = (low + high) / 2
            low, high = (middle, high) if _steepest(middle, surface, polynomial[VALUES]) <= 1 else (low, middle)
        surface[GENTLE] = low * low if high < 1e8 else math.inf


@inlined
def _steepest(r, surface, alpha):
    """Return a bound of the slope |ds/dr| up to the radius r, infinite if the surface ends before r."""
    c, bending, u = numpy.float64(surface[CURVATURE]), numpy.float64(surface[BENDING]), r * r
    return math.inf if bending * u >= 1 - EDGE else 2 * r * _bounded(u, u, c, bending, alpha)[2]
