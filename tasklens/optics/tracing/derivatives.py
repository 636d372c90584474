"""Derivatives of traced rays in reverse and forward mode: each block is traced again, then differentiated.

Arguments that `kernel.trace` has too have the same meaning here.
"""

import numpy

from tasklens.optics.tracing.block import (
    BLOCK,
    CURVING,
    CURVINGS,
    GROUP,
    INDEX,
    L_OUT,
    MU,
    PATH,
    ROWS,
    SLOPE,
    SLOPES,
    THICKNESS,
    VALUE,
    E,
    L,
    M,
    N,
    T,
    W,
    X,
    Y,
    Z,
    add,
    entry,
    fill_colours,
    fill_media,
    horner,
    inlined,
    load,
)
from tasklens.optics.tracing.kernel import propagate
from tasklens.optics.tracing.pose import into_pose, into_pose_jvp, into_pose_vjp, out_of_pose_jvp, out_of_pose_vjp
from tasklens.optics.tracing.refraction import parameters_vjp, refract, refract_jvp, refract_vjp, to_surface


@entry
def reverse(first, last, start, count, lens, status, distances, gradient, b_start, b_lens_of, b_indices_of, b_poses_of):
    """Propagate gradients of rays on the image plane back to the rays at the start and to the lens.

    Args:
        first .. distances: as in `trace`.
        gradient: (7, R) by x, y, (z), l, m, n and path on the image plane; ignored for a lost ray.
        b_start: (7, R) output; or empty.
        b_lens_of: (G, S, 3 + M) sums by curvature, conic, thickness and alpha, for G groups of GROUP rays.
        b_indices_of: (G, S + 1, W) sums; or empty.
        b_poses_of: (G, S, 4, 3) sums by rotation and position; or empty.
    """
    surfaces, _, indices, posed, rotations, _ = lens
    tape = numpy.zeros((len(surfaces) + 1, ROWS * BLOCK), start.dtype)
    g = numpy.zeros(ROWS * BLOCK, start.dtype)
    colours, parks = numpy.zeros(BLOCK + 1, numpy.int64), numpy.zeros(BLOCK, numpy.int64)
    for block in range(first, last, BLOCK):
        size, group = min(BLOCK, last - block), block // GROUP
        b_lens, b_indices, b_poses = b_lens_of[group], b_indices_of[group], b_poses_of[group]
        fill_colours(block, count, colours)
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
                along = add(along, g[Z + i])
            b_lens[k, 2] -= along
            if posed[k]:
                out_of_pose_vjp(s, g, L_OUT, rotations[k], b_poses, k)
            refract_vjp(s, g, surfaces[k])
            parameters_vjp(s, g, surfaces[k], b_lens[k], b_lens.shape[1] - 3)
            if posed[k]:
                into_pose_vjp(s, g, rotations[k], b_poses, k)
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


@entry
def forward(first, last, start, count, lens, status, lost_at, distances, changes, d_image, d_record):
    """Propagate V small changes of the rays at the start and of the lens to the rays on the image plane.

    Args:
        first .. distances: as in `trace`.
        changes: (V,) the first surface that a change affects, 0 for a change of the rays or of an index;
            (V, 7, R) of the rays, or empty;
            (V, S, 3 + 2 M) of curvature, conic, thickness, alpha_2j and j alpha_2j;
            (V, S + 1, W) of the indices, or empty;
            (V, S, 4, 3) of rotation and position, or empty.
        d_image: (V, 7, R) output: x, y, z, l, m, n and path; zero for a lost ray.
        d_record: (V, S, 2, R) output: x and y behind each surface, zero for a ray that is already lost; or empty.
    """
    surfaces, _, indices, posed, rotations, _ = lens
    begins, d_start, d_lens, d_indices, d_poses = changes
    zero, orders = start.dtype.type(0), (d_lens.shape[2] - 3) // 2
    tape = numpy.zeros((len(surfaces) + 1, ROWS * BLOCK), start.dtype)
    d = numpy.zeros(ROWS * BLOCK, start.dtype)
    colours, parks = numpy.zeros(BLOCK + 1, numpy.int64), numpy.zeros(BLOCK, numpy.int64)
    none = numpy.zeros(indices.shape[1], start.dtype)
    for block in range(first, last, BLOCK):
        size = min(BLOCK, last - block)
        fill_colours(block, count, colours)
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
                    horner(s, VALUE, values[3 : 3 + orders])
                    horner(s, SLOPE, values[3 + orders :])
                for i in range(BLOCK if not bends else 0):
                    s[VALUE + i], s[SLOPE + i] = zero, zero
                for i in range(BLOCK):
                    d[W + i], d[E + i] = values[0], values[1]
                if posed[k]:
                    into_pose_jvp(s, d, rotations[k], d_poses, change, k)
                refract_jvp(s, d, surfaces[k])
                if posed[k]:
                    out_of_pose_jvp(s, d, rotations[k], d_poses, change, k)
                if len(d_record) > 0:
                    for i in range(size):
                        d_record[change, k, 0, block + i] = d[X + i] if parks[i] > k else zero
                        d_record[change, k, 1, block + i] = d[Y + i] if parks[i] > k else zero
                for i in range(BLOCK):
                    d[Z + i] -= values[2]
            d_index = d_indices[change, -1] if len(d_indices) > 0 else none
            _to_image(tape[len(surfaces)], d, d_image[change], block, size, status, colours, indices[-1], d_index)


@inlined
def _to_image(s, d, d_image, block, size, status, colours, index, d_index):
    """Propagate the changes of rays behind the last surface to the image plane."""
    for i in range(size):
        if status[block + i] != 0:
            for row in range(7):
                d_image[row, block + i] = 0
            continue
        l, m, n, j = s[L + i], s[M + i], s[N + i], colours[i]
        t = -s[Z + i] / n
        dt = -(d[Z + i] + t * d[N + i]) / n
        d_image[0, block + i] = d[X + i] + t * d[L + i] + dt * l
        d_image[1, block + i] = d[Y + i] + t * d[M + i] + dt * m
        d_image[2, block + i] = 0
        for row in range(3, 6):
            d_image[row, block + i] = d[row * BLOCK + i]
        d_image[6, block + i] = d[PATH + i] + index[j] * dt + d_index[j] * t


@inlined
def _retrace(tape, block, size, start, colours, lens, parks, distances):
    """Trace the rays again: fill the blocks of all surfaces, and one for the rays behind the last surface.

    Ray i is moved to the axis after surface `parks[i]`; -1: at the start.
    """
    surfaces, polynomials, indices, posed, rotations, positions = lens
    load(tape[0], start, block, size)
    for k in range(len(surfaces)):
        s = tape[k]
        for i in range(size):
            if parks[i] < k:
                for row in range(6):
                    s[row * BLOCK + i] = row == 5
        fill_media(s, colours, indices[k], indices[k + 1])
        if posed[k]:
            into_pose(s, rotations[k], positions[k])
        for i in range(size):
            s[T + i] = distances[k, block + i]
        to_surface(s)
        horner(s, SLOPE, polynomials[k, SLOPES])
        horner(s, CURVING, polynomials[k, CURVINGS])
        refract(s, surfaces[k])
        propagate(s, tape[k + 1], posed[k], rotations[k], positions[k], surfaces[k, THICKNESS])
