"""Ray tracing compiled by numba: intersect, refract, propagate, with derivatives in reverse and in forward mode.

A ray has the position P = (x, y, z), z from the vertex, the direction D = (l, m, n) and the optical path. It meets the
surface z = s(u) at P' = P + t D, and leaves with the direction D':

    t:   z + t n = s(u),  u = x'^2 + y'^2                         (intersection)
    e  = -2 ds/du, so that (e x', e y', 1) is the normal;  h = x' l + y' m,  q = n + e h,  g^2 = 1 + e^2 u
    b  = (R - mu q) / g^2,  R^2 = g^2 (1 - mu^2) + mu^2 q^2,  mu = n_before / n_behind
    D' = mu D + b (e x', e y', 1)                                 (Snell's law)

s(u) = c u / (1 + sqrt(1 - (1 + k) c^2 u)) + sum_j alpha_2j u^j. Derivatives need none of the iteration for t: by the
implicit function theorem q dt = ds - dz - t dn - e (x', y').(dx + t dl, dy + t dm), where ds is the change of the sag
by the surface's own parameters.

Rays are traced in blocks that stay in the cache; the loops over a block become vector instructions. A block is one flat
array, whose rows, named below, hold one number per ray. What happens to few rays (a difficult intersection, a loss) is
done for each of them. There is no tape: derivatives trace a block again from the stored distances t. `surface` and
`reference` state the same in plain autograd, and the tests compare the two.
"""

import math

import numba
import numpy

from tasklens.optics.aspheres import EDGE
from tasklens.optics.rays import GRAZING, RayStatus

BLOCK = 128  # rays
GROUP = 16 * BLOCK  # rays whose gradients are summed together, whatever the number of threads
CHUNK = 8  # orders of an asphere that are evaluated in registers; coefficients are padded to a multiple
# Rows of a block; for derivatives, the same names are those of its change or gradient.
(
    X,
    Y,
    Z,
    L,
    M,
    N,
    PATH,
    L_OUT,
    M_OUT,
    N_OUT,
    MU,
    INDEX,
    T,
    U,
    W,
    E,
    B,
    VALUE,
    SLOPE,
    CURVING,
    A0,
    B0,
    C0,
    MEETS,
    WIDEST,
) = range(0, 25 * BLOCK, BLOCK)
ROWS = 25
# Columns of the table of surfaces: c, (1 + k) c^2, distance to the next vertex, largest u of the clear aperture, and
# a u up to which no slope is above 1, infinite for a plane
CURVATURE, BENDING, THICKNESS, LIMIT, GENTLE = range(5)
COLUMNS = 5
VALUES, SLOPES, CURVINGS = range(3)  # polynomials of a surface: alpha_2j, j alpha_2j and j (j - 1) alpha_2j

_NEWTON_STEPS = 8  # for all rays of a block; those that have not converged then are taken one by one
_SAFE_STEPS = 400
_SAFE_TOLERANCE = 1e-9  # [mm]; the error after a step is of the order of its square, and one more follows
_CELLS = 64  # of the radius, in a profile of slopes
_FAR = 1e15  # [mm^2] largest u at which a ray meets a surface
_MISSED, _VIGNETTED, _REFLECTED = (
    int(RayStatus.MISSED),
    int(RayStatus.VIGNETTED),
    int(RayStatus.TOTAL_INTERNAL_REFLECTION),
)

# The compiler may contract products and sums, but reorders nothing but the sums of `_add`.
compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
inlined = numba.njit(forceinline=True, error_model="numpy", fastmath={"contract"})  # rows are then known


@numba.njit(fastmath={"contract", "reassoc", "nsz"})
def _add(total, value):
    """Add to a sum over rays, in any order."""
    return total + value


@inlined
def _horner(s, row, coefficients):
    """Fill a row with sum_j coefficients_j u^(j - 1)."""
    zero = s.dtype.type(0)
    for i in range(BLOCK):
        s[row + i] = zero
    for first in range(len(coefficients) - CHUNK, -1, -CHUNK):
        a0, a1, a2, a3 = coefficients[first], coefficients[first + 1], coefficients[first + 2], coefficients[first + 3]
        a4, a5, a6, a7 = (
            coefficients[first + 4],
            coefficients[first + 5],
            coefficients[first + 6],
            coefficients[first + 7],
        )
        for i in range(BLOCK):
            u = s[U + i]
            v = ((s[row + i] * u + a7) * u + a6) * u + a5
            s[row + i] = ((((v * u + a4) * u + a3) * u + a2) * u + a1) * u + a0


# ---- intersection


@inlined
def _newton(s, surface, polynomials):
    """Iterate the rays of a block by Newton's method from the vertex plane to the surface.

    F(t) = z + t n - s(u) = 0. The crossing is the first one where F' > 0 on the whole way from the ray's last point:
    F' = n - 2 ds/du h, where |h| <= r sin i for the angle i to the axis, and 2 r ds/du is the slope of the surface.

    Returns the number of rays of which this does not show that they meet the surface, and there first.
    """
    number = s.dtype.type
    zero, one, edge, grazing = number(0), number(1), number(EDGE), number(GRAZING)
    c, bending, gentle = surface[CURVATURE], surface[BENDING], surface[GENTLE]
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
        _horner(s, VALUE, polynomials[VALUES])
        _horner(s, SLOPE, polynomials[SLOPES])
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


@compiled
def first_crossing(x, y, z, l, m, n, surface, alpha):
    """Return the distance t along a ray to its first crossing of a surface, NaN if there is none.

    A ray in front of the surface goes forward, one behind it backward, to the first crossing. Steps never pass it: with
    |F''| <= B on the next D mm, |F| cannot vanish before 2 |F| / (F' + sqrt(F'^2 + 2 B |F|)), F' being the derivative
    towards the surface. This is Newton's step where |F| is small, and a ray that meets nothing comes to the edge of the
    surface, where 1 - (1 + k) c^2 u is zero: a proof that there is no crossing.
    """
    c, bending = float(surface[CURVATURE]), float(surface[BENDING])
    u_end = min((1 - EDGE) / bending, _FAR) if bending > 0 else _FAR
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
        return math.nan  # at the edge it is already behind the surface, or before it
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


@compiled
def _bounded(u, u_most, c, bending, alpha):
    """Return sag and ds/du at u, and bounds of |ds/du| and |d^2 s/du^2| up to u_most."""
    root = math.sqrt(max(1 - bending * u, EDGE))
    w = 1 / math.sqrt(max(min(1 - bending * u_most, 1.0), EDGE))
    value, slope, steepest, most = 0.0, 0.0, 0.0, 0.0
    for j in range(len(alpha), 0, -1):
        a = float(alpha[j - 1])
        slope = slope * u + value
        value = value * u + a
        steepest = steepest * u_most + j * abs(a)
        if j > 1:
            most = most * u_most + j * (j - 1) * abs(a)
    sag = c * u / (1 + root) + u * value
    slope = 0.5 * c / root + slope * u + value
    return sag, slope, 0.5 * abs(c) * w + steepest, 0.25 * abs(c * bending) * w * w * w + most


@compiled
def gentle_radii(surfaces, polynomials):
    """Fill the column GENTLE."""
    for k in range(len(surfaces)):
        surface, polynomial = surfaces[k], polynomials[k]
        low, high = 0.0, 1.0
        while high < 1e8 and _steepest(high, surface, polynomial[VALUES]) <= 1:
            low, high = high, 2 * high
        for _ in range(12):
            middle = (low + high) / 2
            low, high = (middle, high) if _steepest(middle, surface, polynomial[VALUES]) <= 1 else (low, middle)
        surface[GENTLE] = low * low if high < 1e8 else math.inf


@compiled
def _steepest(r, surface, alpha):
    """Return a bound of the slope |ds/dr| up to the radius r, infinite where the surface ends before."""
    c, bending, u = float(surface[CURVATURE]), float(surface[BENDING]), r * r
    return math.inf if bending * u >= 1 - EDGE else 2 * r * _bounded(u, u, c, bending, alpha)[2]


@compiled
def _fill_slopes(slopes, r_most, surface, alpha):
    """Fill a profile of slopes: its radius r_most, and bounds of |ds/dr| up to k + 1 of _CELLS parts of it.

    In a cell of width w a function is at most w^2 / 8 max |f''| above its values at the ends; here f = ds/dr.
    """
    slopes[0] = r_most
    width, steepest, inner = r_most / _CELLS, 0.0, 0.0
    c, bending = float(surface[CURVATURE]), float(surface[BENDING])
    for k in range(_CELLS):
        r = (k + 1) * width
        u = r * r
        if bending * u >= 1 - EDGE:
            slopes[1 + k :] = math.inf
            return
        second, third = 0.0, 0.0
        for j in range(len(alpha), 1, -1):
            a = j * (j - 1) * abs(float(alpha[j - 1]))
            second = second * u + a
            if j > 2:
                third = third * u + (j - 2) * a
        w = 1 / math.sqrt(max(min(1 - bending * u, 1.0), EDGE))
        second += 0.25 * abs(c * bending) * w**3
        third += 0.375 * abs(c) * bending * bending * w**5
        outer = abs(2 * r * _bounded(u, u, c, bending, alpha)[1])
        steepest = max(steepest, max(inner, outer) + width * width / 8 * (12 * r * second + 8 * r * u * third))
        slopes[1 + k], inner = steepest, outer


# ---- from surface to surface


@inlined
def _media(s, colours, index, behind):
    """Fill the rows of the index in front of a surface and of mu from the indices (W,) of each colour."""
    before, mu = index[colours[0]], index[colours[0]] / behind[colours[0]]
    for i in range(BLOCK):
        s[INDEX + i], s[MU + i] = before, mu
    for i in range(BLOCK if colours[BLOCK] > 1 else 0):
        k = colours[i]
        s[INDEX + i], s[MU + i] = index[k], index[k] / behind[k]


@inlined
def _to_surface(s):
    """Move rays by t."""
    for i in range(BLOCK):
        t = s[T + i]
        s[PATH + i] += s[INDEX + i] * t
        x, y = s[X + i] + t * s[L + i], s[Y + i] + t * s[M + i]
        s[X + i], s[Y + i] = x, y
        s[Z + i] += t * s[N + i]
        s[U + i] = x * x + y * y


@inlined
def _refract(s, surface):
    """Refract rays at a surface, the row SLOPE being filled. Returns the number of rays that do not go on."""
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
        s[A0 + i] = one if u <= limit else -one
        s[B0 + i] = one if passes else -one
        lost += not (passes & (u <= limit))
    return lost


@inlined
def _turn(s, x, r):
    """Multiply the vectors in three rows from x on by the matrix r."""
    y, z = x + BLOCK, x + 2 * BLOCK
    for i in range(BLOCK):
        a, b, c = s[x + i], s[y + i], s[z + i]
        s[x + i] = r[0, 0] * a + r[0, 1] * b + r[0, 2] * c
        s[y + i] = r[1, 0] * a + r[1, 1] * b + r[1, 2] * c
        s[z + i] = r[2, 0] * a + r[2, 1] * b + r[2, 2] * c


@compiled
def _into_pose(s, rotation, position):
    """Transform rays from the axes of the nominal vertex to those of the surface: P' = R^T (P - p), D' = R^T D."""
    for i in range(BLOCK):
        s[X + i], s[Y + i], s[Z + i] = s[X + i] - position[0], s[Y + i] - position[1], s[Z + i] - position[2]
    _turn(s, X, rotation.T)
    _turn(s, L, rotation.T)


@compiled
def _out_of_pose(s, rotation, position):
    """Transform rays back to the axes of the nominal vertex: P = R P' + p, D = R D'."""
    _turn(s, X, rotation)
    _turn(s, L, rotation)
    for i in range(BLOCK):
        s[X + i], s[Y + i], s[Z + i] = s[X + i] + position[0], s[Y + i] + position[1], s[Z + i] + position[2]


@inlined
def _behind(s, behind, posed, rotation, position, thickness):
    """Put the rays behind a surface into the block `behind`, which may be the same, z from the next vertex."""
    for row in range(0, 3 * BLOCK, BLOCK):
        for i in range(BLOCK):
            behind[X + row + i] = s[X + row + i]
            behind[L + row + i] = s[L_OUT + row + i]
    for i in range(BLOCK):
        behind[PATH + i] = s[PATH + i]
    if posed:
        _out_of_pose(behind, rotation, position)
    for i in range(BLOCK):
        behind[Z + i] -= thickness


@compiled
def _intersect(s, surface, polynomials, slopes, fate):
    """Fill the row T with the distances to the surface; mark rays that miss it in `fate`, and leave them in place.

    `slopes` is a profile of slopes, filled when it is needed. Returns the number of rays that miss the surface.
    """
    if surface[CURVATURE] == 0 and surface[GENTLE] == math.inf:  # a plane
        for i in range(BLOCK):
            s[T + i] = -s[Z + i] / s[N + i]
        return 0
    missed = 0
    for i in range(BLOCK if _newton(s, surface, polynomials) > 0 else 0):
        x, y, z, l, m, n = s[X + i], s[Y + i], s[Z + i], s[L + i], s[M + i], s[N + i]
        if s[MEETS + i] > 0:
            r = math.sqrt(s[WIDEST + i])
            if not r < slopes[0]:
                _fill_slopes(slopes, 1.25 * r, surface, polynomials[VALUES])
            steepest = slopes[1 + int(r / slopes[0] * _CELLS)]
            if steepest * steepest * s[C0 + i] < n * n:
                continue
        t = first_crossing(float(x), float(y), float(z), float(l), float(m), float(n), surface, polynomials[VALUES])
        if math.isnan(t):
            fate[i] = _MISSED
            missed += 1
            t = 0.0
        s[T + i] = t
    return missed


@compiled
def _colours(first, count, colours):
    """Fill `colours` with the index of the wavelength of each ray of a block, and last, whether there are several."""
    waves, each = count
    k, left = (first // each) % waves, each - first % each
    colours[BLOCK] = 2 if left < BLOCK and waves > 1 else 1
    for i in range(BLOCK):
        colours[i] = k
        left -= 1
        if left == 0:
            left = each
            k = k + 1 if k + 1 < waves else 0


@compiled
def _park(s, i):
    """Put a ray on the axis, where it stays finite."""
    s[X + i], s[Y + i], s[Z + i], s[L + i], s[M + i], s[N + i] = 0, 0, 0, 0, 0, 1


@compiled
def _lose(s, i, ray, image):
    """Keep the last point of a ray, and put it on the axis, where it stays finite."""
    for k in range(7):
        image[k, ray] = s[k * BLOCK + i]
        s[k * BLOCK + i] = 0
    image[3, ray], image[4, ray], image[5, ray] = 0, 0, 1
    s[N + i] = 1


@compiled
def trace(first, last, start, count, lens, image, status, lost_at, distances, record):
    """Trace the rays first .. last - 1 through all surfaces to the image plane.

    Args:
        start: (7, R) x, y, z, l, m, n and path of the rays, ordered (..., W, N).
        count: (W, N).
        lens: tables as from `trace._tables`.
        image: (7, R) the same on the image plane; for a lost ray its last point, z from the vertex of the surface where
            it was lost, turned along the axis.
        status, lost_at: (R,) in and out.
        distances: (S, R) t to each surface, for the derivatives; or of no surface.
        record: (S, 7, R) rays behind each surface; or of no surface.
    """
    surfaces, polynomials, indices, posed, rotations, positions = lens
    s = numpy.zeros(ROWS * BLOCK, start.dtype)
    colours, fate = numpy.zeros(BLOCK + 1, numpy.int64), numpy.zeros(BLOCK, numpy.int8)
    slopes = numpy.zeros((len(surfaces), 1 + _CELLS))
    for block in range(first, last, BLOCK):
        size = min(BLOCK, last - block)
        _colours(block, count, colours)
        _load(s, start, block, size)
        for i in range(size):
            ray = block + i
            if status[ray] == 0 and not s[N + i] > GRAZING:  # along the first surface, away from it, or not a number
                status[ray], lost_at[ray] = _MISSED, 0
            if status[ray] != 0:
                _lose(s, i, ray, image)
        for k in range(len(surfaces)):
            surface = surfaces[k]
            _media(s, colours, indices[k], indices[k + 1])
            if posed[k]:
                _into_pose(s, rotations[k], positions[k])
            lost = _intersect(s, surface, polynomials[k], slopes[k], fate)
            if len(distances) > 0:
                for i in range(size):
                    distances[k, block + i] = s[T + i]
            _to_surface(s)
            _horner(s, SLOPE, polynomials[k, SLOPES])
            lost += _refract(s, surface)
            _behind(s, s, posed[k], rotations[k], positions[k], surface.dtype.type(0))
            if lost > 0:
                for i in range(size):
                    if fate[i] == 0 and s[A0 + i] < 0:
                        fate[i] = _VIGNETTED
                    elif fate[i] == 0 and s[B0 + i] < 0:
                        fate[i] = _REFLECTED
                    if fate[i] > 0:
                        status[block + i], lost_at[block + i], fate[i] = fate[i], k, 0
                        _lose(s, i, block + i, image)
            if len(record) > 0:
                for i in range(size):
                    for row in range(7):
                        there = image[row, block + i] if status[block + i] else s[row * BLOCK + i]
                        record[k, row, block + i] = there
            for i in range(BLOCK):
                s[Z + i] -= surface[THICKNESS]
        for i in range(size):
            if status[block + i] == 0:
                t = -s[Z + i] / s[N + i]
                s[X + i] += t * s[L + i]
                s[Y + i] += t * s[M + i]
                s[Z + i] = 0
                s[PATH + i] += indices[-1, colours[i]] * t
                for row in range(7):
                    image[row, block + i] = s[row * BLOCK + i]


@inlined
def _load(s, start, block, size):
    """Load rays into a block, and fill it up with rays on the axis."""
    for row in range(7):
        for i in range(size):
            s[row * BLOCK + i] = start[row, block + i]
        for i in range(size, BLOCK):
            s[row * BLOCK + i] = row == 5


# ---- derivatives


@compiled
def _retrace(tape, block, size, start, colours, lens, parks, distances):
    """Fill the blocks of all surfaces, and one for the rays behind the last, as rays were traced.

    A ray is on the axis behind the surface `parks` of the block, from the start where that is -1.
    """
    surfaces, polynomials, indices, posed, rotations, positions = lens
    _load(tape[0], start, block, size)
    for k in range(len(surfaces)):
        s = tape[k]
        for i in range(size):
            if parks[i] < k:
                for row in range(6):
                    s[row * BLOCK + i] = row == 5
        _media(s, colours, indices[k], indices[k + 1])
        if posed[k]:
            _into_pose(s, rotations[k], positions[k])
        for i in range(size):
            s[T + i] = distances[k, block + i]
        _to_surface(s)
        _horner(s, SLOPE, polynomials[k, SLOPES])
        _horner(s, CURVING, polynomials[k, CURVINGS])
        _refract(s, surfaces[k])
        _behind(s, tape[k + 1], posed[k], rotations[k], positions[k], surfaces[k, THICKNESS])


@compiled
def _refract_vjp(s, g, surface):
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


@compiled
def _to_parameters(s, g, surface, total, orders):
    """Add the gradients of a surface's parameters to `total`: curvature, conic, and from column 3 on alpha."""
    number = s.dtype.type
    one, half = number(1), number(0.5)
    by_curvature, by_conic = number(0), number(0)
    for i in range(BLOCK):
        u, w, b_by_u, b_slope = s[U + i], s[W + i], g[VALUE + i], g[SLOPE + i]
        v = w / (one + w)  # 1 / (1 + sqrt(1 - (1 + k) c^2 u))
        cube = half * w * w * w
        by_curvature = _add(by_curvature, b_by_u * w * v + b_slope * cube)
        by_conic = _add(by_conic, u * (b_by_u * w * v * v + b_slope * cube))
        g[A0 + i] = one  # u^(j - 1)
    total[0] += by_curvature
    total[1] += by_conic * half * surface[CURVATURE] * surface[CURVATURE] * surface[CURVATURE]
    for j in range(orders):
        by_value, by_slope = number(0), number(0)
        for i in range(BLOCK):
            power = g[A0 + i]
            by_value = _add(by_value, power * g[VALUE + i])
            by_slope = _add(by_slope, power * g[SLOPE + i])
            g[A0 + i] = power * s[U + i]
        total[3 + j] += by_value + (j + 1) * by_slope


@compiled
def reverse(first, last, start, count, lens, status, distances, gradient, b_start, b_lens_of, b_indices_of, b_poses_of):
    """Propagate gradients of rays on the image plane back to the rays at the start and to the lens.

    Args:
        first .. distances: as of `trace`.
        gradient: (7, R) at x, y, (z), l, m, n and path on the image plane; a lost ray has none.
        b_start: (7, R), filled; or empty.
        b_lens: (G, S, 3 + M), added to: curvature, conic, thickness and alpha; of G groups of GROUP rays.
        b_indices: (G, S + 1, W), added to; or of no surface.
        b_poses: (G, S, 4, 3), added to: rotation and position; or of no surface.
    """
    surfaces, _, indices, posed, rotations, _ = lens
    tape = numpy.zeros((len(surfaces) + 1, ROWS * BLOCK), start.dtype)
    g = numpy.zeros(ROWS * BLOCK, start.dtype)
    colours, parks = numpy.zeros(BLOCK + 1, numpy.int64), numpy.zeros(BLOCK, numpy.int64)
    for block in range(first, last, BLOCK):
        size, group = min(BLOCK, last - block), block // GROUP
        b_lens, b_indices, b_poses = b_lens_of[group], b_indices_of[group], b_poses_of[group]
        _colours(block, count, colours)
        for i in range(size):
            parks[i] = -1 if status[block + i] else len(surfaces)
        _retrace(tape, block, size, start, colours, lens, parks, distances)
        for row in range(7):
            for i in range(BLOCK):
                g[row * BLOCK + i] = 0
            for i in range(size):
                if status[block + i] == 0:
                    g[row * BLOCK + i] = gradient[row, block + i]
        s = tape[len(surfaces)]
        for i in range(BLOCK):
            l, m, n, b_x, b_y, b_path = s[L + i], s[M + i], s[N + i], g[X + i], g[Y + i], g[PATH + i]
            t = -s[Z + i] / n
            tau = (b_path * indices[-1, colours[i]] + b_x * l + b_y * m) / n
            g[L + i] += t * b_x
            g[M + i] += t * b_y
            g[N + i] -= t * tau
            g[Z + i] = -tau
            g[T + i] = t * b_path
        if len(b_indices) > 0:
            for i in range(size):
                b_indices[-1, colours[i]] += g[T + i]
        for k in range(len(surfaces) - 1, -1, -1):
            s = tape[k]
            along = s.dtype.type(0)
            for i in range(BLOCK):
                along = _add(along, g[Z + i])
            b_lens[k, 2] -= along
            if posed[k]:
                _turn_vjp(s, g, L_OUT, rotations[k], b_poses, k)
            _refract_vjp(s, g, surfaces[k])
            _to_parameters(s, g, surfaces[k], b_lens[k], b_lens.shape[1] - 3)
            if posed[k]:
                _turn_back_vjp(s, g, rotations[k], b_poses, k)
            if len(b_indices) > 0:
                for i in range(size):
                    j = colours[i]
                    b_ratio = g[W + i] / indices[k + 1, j]
                    b_indices[k + 1, j] -= b_ratio * s[MU + i]
                    b_indices[k, j] += b_ratio + s[T + i] * g[PATH + i]
        if len(b_start) > 0:
            for row in range(7):
                for i in range(size):
                    b_start[row, block + i] = g[row * BLOCK + i]


@compiled
def _turn_vjp(s, g, out, rotation, b_poses, k):
    """Propagate gradients through P = R P' + p and D = R D', to the axes of the surface."""
    for i in range(BLOCK):
        for a in range(3):
            b_p, b_d = g[X + a * BLOCK + i], g[L + a * BLOCK + i]
            b_poses[k, 3, a] += b_p
            for j in range(3):
                b_poses[k, a, j] += b_p * s[X + j * BLOCK + i] + b_d * s[out + j * BLOCK + i]
    _turn(g, X, rotation.T)
    _turn(g, L, rotation.T)


@compiled
def _turn_back_vjp(s, g, rotation, b_poses, k):
    """Propagate gradients through P' = R^T (P - p) and D' = R^T D, to the axes of the nominal vertex."""
    for i in range(BLOCK):
        for a in range(3):
            before, way = 0.0, 0.0  # of P - p = R P' and of D = R D'
            for j in range(3):
                direction = s[L + j * BLOCK + i]
                before += rotation[a, j] * (s[X + j * BLOCK + i] - s[T + i] * direction)
                way += rotation[a, j] * direction
            for j in range(3):
                b_poses[k, a, j] += before * g[X + j * BLOCK + i] + way * g[L + j * BLOCK + i]
    _turn(g, X, rotation)
    _turn(g, L, rotation)
    for i in range(BLOCK):
        for a in range(3):
            b_poses[k, 3, a] -= g[X + a * BLOCK + i]


@compiled
def _refract_jvp(s, d, surface):
    """Propagate small changes d of the rays before a surface to those behind it.

    Rows VALUE and SLOPE of s: changes of sag / u and ds/du by the surface's asphere coefficients; rows MU, INDEX, W and
    E of d: changes of mu, of the index before, and of curvature and conic.
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


@compiled
def forward(
    first,
    last,
    start,
    count,
    lens,
    status,
    lost_at,
    distances,
    begins,
    d_start,
    d_lens,
    d_indices,
    d_poses,
    d_image,
    d_record,
):
    """Propagate V small changes of the rays at the start and of the lens to the rays on the image plane.

    Args:
        first .. distances: as of `trace`.
        begins: (V,) the first surface that a change concerns; 0 where it is one of the rays or of an index.
        d_start: (V, 7, R), or of no change.
        d_lens: (V, S, 3 + 2 M) of curvature, conic, thickness, alpha_2j and j alpha_2j.
        d_indices: (V, S + 1, W), or of no change.
        d_poses: (V, S, 4, 3) of rotation and position, or of no change.
        d_image: (V, 7, R) filled: x, y, z, l, m, n and path; zero for a lost ray.
        d_record: (V, S, 2, R) filled: x and y behind each surface, zero for a ray lost so far; or of no change.
    """
    surfaces, _, indices, posed, rotations, _ = lens
    zero, orders = start.dtype.type(0), (d_lens.shape[2] - 3) // 2
    tape = numpy.zeros((len(surfaces) + 1, ROWS * BLOCK), start.dtype)
    d = numpy.zeros(ROWS * BLOCK, start.dtype)
    colours, parks = numpy.zeros(BLOCK + 1, numpy.int64), numpy.zeros(BLOCK, numpy.int64)
    for block in range(first, last, BLOCK):
        size = min(BLOCK, last - block)
        _colours(block, count, colours)
        for i in range(size):
            parks[i] = lost_at[block + i] if status[block + i] else len(surfaces)
        _retrace(tape, block, size, start, colours, lens, parks, distances)
        for change in range(len(begins)):
            for i in range(7 * BLOCK):
                d[i] = 0
            if len(d_start) > 0:
                for row in range(7):
                    for i in range(size):
                        if status[block + i] == 0:
                            d[row * BLOCK + i] = d_start[change, row, block + i]
            for k in range(begins[change], len(surfaces)):
                s, values = tape[k], d_lens[change, k]
                if len(d_indices) > 0:
                    for i in range(BLOCK):
                        j = colours[i]
                        d[INDEX + i] = d_indices[change, k, j]
                        d[MU + i] = (d[INDEX + i] - s[MU + i] * d_indices[change, k + 1, j]) / indices[k + 1, j]
                bends = False
                for j in range(3, 3 + orders):
                    bends |= values[j] != 0
                if bends:
                    _horner(s, VALUE, values[3 : 3 + orders])
                    _horner(s, SLOPE, values[3 + orders :])
                for i in range(BLOCK if not bends else 0):
                    s[VALUE + i], s[SLOPE + i] = zero, zero
                for i in range(BLOCK):
                    d[W + i], d[E + i] = values[0], values[1]
                if posed[k]:
                    _turn_jvp(s, d, rotations[k], d_poses, change, k)
                _refract_jvp(s, d, surfaces[k])
                if posed[k]:
                    _turn_back_jvp(s, d, rotations[k], d_poses, change, k)
                if len(d_record) > 0:
                    for i in range(size):
                        d_record[change, k, 0, block + i] = d[X + i] if parks[i] > k else zero
                        d_record[change, k, 1, block + i] = d[Y + i] if parks[i] > k else zero
                for i in range(BLOCK):
                    d[Z + i] -= values[2]
            s = tape[len(surfaces)]
            for i in range(size):
                if status[block + i] != 0:
                    for row in range(7):
                        d_image[change, row, block + i] = 0
                    continue
                l, m, n, j = s[L + i], s[M + i], s[N + i], colours[i]
                t = -s[Z + i] / n
                dt = -(d[Z + i] + t * d[N + i]) / n
                d_image[change, 0, block + i] = d[X + i] + t * d[L + i] + dt * l
                d_image[change, 1, block + i] = d[Y + i] + t * d[M + i] + dt * m
                d_image[change, 2, block + i] = 0
                for row in range(3, 6):
                    d_image[change, row, block + i] = d[row * BLOCK + i]
                d_index = d_indices[change, -1, j] if len(d_indices) > 0 else zero
                d_image[change, 6, block + i] = d[PATH + i] + indices[-1, j] * dt + d_index * t


@compiled
def _turn_jvp(s, d, rotation, d_poses, change, k):
    """Propagate changes through P' = R^T (P - p) and D' = R^T D, to the axes of the surface."""
    if len(d_poses) > 0:
        for i in range(BLOCK):
            for a in range(3):
                d[X + a * BLOCK + i] -= d_poses[change, k, 3, a]
    _turn(d, X, rotation.T)
    _turn(d, L, rotation.T)
    if len(d_poses) == 0:
        return
    for i in range(BLOCK):
        for a in range(3):
            before, way = 0.0, 0.0  # of P - p = R P' and of D = R D'
            for j in range(3):
                direction = s[L + j * BLOCK + i]
                before += rotation[a, j] * (s[X + j * BLOCK + i] - s[T + i] * direction)
                way += rotation[a, j] * direction
            for j in range(3):
                d[X + j * BLOCK + i] += d_poses[change, k, a, j] * before
                d[L + j * BLOCK + i] += d_poses[change, k, a, j] * way


@compiled
def _turn_back_jvp(s, d, rotation, d_poses, change, k):
    """Propagate changes through P = R P' + p and D = R D', to the axes of the nominal vertex."""
    _turn(d, X, rotation)
    _turn(d, L, rotation)
    if len(d_poses) == 0:
        return
    for i in range(BLOCK):
        for a in range(3):
            d[X + a * BLOCK + i] += d_poses[change, k, 3, a]
            for j in range(3):
                d[X + a * BLOCK + i] += d_poses[change, k, a, j] * s[X + j * BLOCK + i]
                d[L + a * BLOCK + i] += d_poses[change, k, a, j] * s[L_OUT + j * BLOCK + i]
