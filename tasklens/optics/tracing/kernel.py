"""Rays through all surfaces of a lens, compiled by numba: intersect, refract, propagate, one block after another.

Rare cases (a difficult intersection, a loss) are processed ray by ray. There is no tape: derivatives trace a block
again from the stored distances t. `reference_tracer` implements the same in plain autograd.
"""

import numpy

from tasklens.optics.rays import GRAZING, RayStatus
from tasklens.optics.tracing.block import (
    BLOCK,
    GOES_ON,
    INDEX,
    L_OUT,
    PASSES,
    PATH,
    ROWS,
    SLOPE,
    SLOPES,
    THICKNESS,
    L,
    M,
    N,
    T,
    X,
    Y,
    Z,
    entry,
    fill_colours,
    fill_media,
    horner,
    inlined,
    load,
)
from tasklens.optics.tracing.crossing import PROFILE, intersect
from tasklens.optics.tracing.pose import into_pose, out_of_pose
from tasklens.optics.tracing.refraction import refract, to_surface

_MISSED, _VIGNETTED = int(RayStatus.MISSED), int(RayStatus.VIGNETTED)
_REFLECTED = int(RayStatus.TOTAL_INTERNAL_REFLECTION)


@entry
def trace(first, last, start, count, lens, image, status, lost_at, distances, record):
    """Trace the rays first .. last - 1 through all surfaces to the image plane.

    Args:
        start: (7, R) x, y, z, l, m, n and path of the rays, ordered (..., W, N).
        count: (W, N).
        lens: tables as from `traced._tables`.
        image: (7, R) output, the same on the image plane; for a lost ray its last point, z from the vertex of the
            surface where it was lost, its direction along the axis.
        status, lost_at: (R,) input and output.
        distances: (S, R) output, t to each surface, for the derivatives.
        record: (S, 7, R) output, rays behind each surface; or empty.
    """
    surfaces, polynomials, indices, posed, rotations, positions = lens
    s = numpy.zeros(ROWS * BLOCK, start.dtype)
    colours, lost_status = numpy.zeros(BLOCK + 1, numpy.int64), numpy.zeros(BLOCK, numpy.int8)
    slopes = numpy.zeros((len(surfaces), PROFILE))
    for block in range(first, last, BLOCK):
        size = min(BLOCK, last - block)
        fill_colours(block, count, colours)
        load(s, start, block, size)
        for i in range(size):
            ray = block + i
            if status[ray] == 0 and not s[N + i] > GRAZING:  # along the first surface, away from it, or not a number
                status[ray], lost_at[ray] = _MISSED, 0
            if status[ray] != 0:
                _lose(s, i, ray, image)
        for k in range(len(surfaces)):
            surface = surfaces[k]
            fill_media(s, colours, indices[k], indices[k + 1])
            if posed[k]:
                into_pose(s, rotations[k], positions[k])
            lost = intersect(s, surface, polynomials[k], slopes[k], lost_status)
            for i in range(size):
                distances[k, block + i] = s[T + i]
            to_surface(s)
            horner(s, SLOPE, polynomials[k, SLOPES])
            lost += refract(s, surface)
            propagate(s, s, posed[k], rotations[k], positions[k], surface.dtype.type(0))
            if lost > 0:
                for i in range(size):
                    if lost_status[i] == 0 and s[PASSES + i] < 0:
                        lost_status[i] = _VIGNETTED
                    elif lost_status[i] == 0 and s[GOES_ON + i] < 0:
                        lost_status[i] = _REFLECTED
                    if lost_status[i] > 0:
                        status[block + i], lost_at[block + i], lost_status[i] = lost_status[i], k, 0
                        _lose(s, i, block + i, image)
            if len(record) > 0:
                for i in range(size):
                    for row in range(7):
                        value = image[row, block + i] if status[block + i] else s[row * BLOCK + i]
                        record[k, row, block + i] = value
            for i in range(BLOCK):
                s[Z + i] -= surface[THICKNESS]
        fill_media(s, colours, indices[-1], indices[-1])
        for i in range(BLOCK):
            t = -s[Z + i] / s[N + i]
            s[X + i] += t * s[L + i]
            s[Y + i] += t * s[M + i]
            s[Z + i] = 0
            s[PATH + i] += s[INDEX + i] * t
        for row in range(7):
            for i in range(size):
                image[row, block + i] = image[row, block + i] if status[block + i] else s[row * BLOCK + i]


@inlined
def _lose(s, i, ray, image):
    """Store the last point of a ray, and move the ray to the axis, where it stays finite."""
    for k in range(7):
        image[k, ray] = s[k * BLOCK + i]
        s[k * BLOCK + i] = 0
    image[3, ray], image[4, ray], image[5, ray] = 0, 0, 1
    s[N + i] = 1


@inlined
def propagate(s, out, posed, rotation, position, thickness):
    """Write the rays behind a surface to the block `out`, which may be `s`, with z from the next vertex."""
    for row in range(0, 3 * BLOCK, BLOCK):
        for i in range(BLOCK):
            out[X + row + i] = s[X + row + i]
            out[L + row + i] = s[L_OUT + row + i]
    for i in range(BLOCK):
        out[PATH + i] = s[PATH + i]
    if posed:
        out_of_pose(out, rotation, position)
    for i in range(BLOCK):
        out[Z + i] -= thickness
