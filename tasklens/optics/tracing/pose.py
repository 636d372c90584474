"""Rays in the axes of a surface that is decentred or tilted, with derivatives.

A point P' in these axes is at P = R P' + p from the nominal vertex, and D = R D'.
"""

from tasklens.optics.tracing.block import BLOCK, L_OUT, L, T, X, Y, Z, inlined


@inlined
def into_pose(s, rotation, position):
    """Transform rays from the axes of the nominal vertex to those of the surface: P' = R^T (P - p), D' = R^T D."""
    for i in range(BLOCK):
        s[X + i], s[Y + i], s[Z + i] = s[X + i] - position[0], s[Y + i] - position[1], s[Z + i] - position[2]
    _turn(s, X, rotation.T)
    _turn(s, L, rotation.T)


@inlined
def out_of_pose(s, rotation, position):
    """Transform rays back to the axes of the nominal vertex: P = R P' + p, D = R D'."""
    _turn(s, X, rotation)
    _turn(s, L, rotation)
    for i in range(BLOCK):
        s[X + i], s[Y + i], s[Z + i] = s[X + i] + position[0], s[Y + i] + position[1], s[Z + i] + position[2]


@inlined
def out_of_pose_vjp(s, g, out, rotation, b_poses, k):
    """Propagate gradients through P = R P' + p and D = R D', to the axes of the surface."""
    for i in range(BLOCK):
        for a in range(3):
            b_p, b_d = g[X + a * BLOCK + i], g[L + a * BLOCK + i]
            b_poses[k, 3, a] += b_p
            for j in range(3):
                b_poses[k, a, j] += b_p * s[X + j * BLOCK + i] + b_d * s[out + j * BLOCK + i]
    _turn(g, X, rotation.T)
    _turn(g, L, rotation.T)


@inlined
def into_pose_vjp(s, g, rotation, b_poses, k):
    """Propagate gradients through P' = R^T (P - p) and D' = R^T D, to the axes of the nominal vertex."""
    for i in range(BLOCK):
        for a in range(3):
            before, way = _before(s, rotation, i, a)
            for j in range(3):
                b_poses[k, a, j] += before * g[X + j * BLOCK + i] + way * g[L + j * BLOCK + i]
    _turn(g, X, rotation)
    _turn(g, L, rotation)
    for i in range(BLOCK):
        for a in range(3):
            b_poses[k, 3, a] -= g[X + a * BLOCK + i]


@inlined
def into_pose_jvp(s, d, rotation, d_poses, change, k):
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
            before, way = _before(s, rotation, i, a)
            for j in range(3):
                d[X + j * BLOCK + i] += d_poses[change, k, a, j] * before
                d[L + j * BLOCK + i] += d_poses[change, k, a, j] * way


@inlined
def out_of_pose_jvp(s, d, rotation, d_poses, change, k):
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


@inlined
def _before(s, rotation, i, a):
    """Return component a of P - p = R P' and of D = R D' for ray i in front of the surface."""
    before, way = 0.0, 0.0
    for j in range(3):
        direction = s[L + j * BLOCK + i]
        before += rotation[a, j] * (s[X + j * BLOCK + i] - s[T + i] * direction)
        way += rotation[a, j] * direction
    return before, way


@inlined
def _turn(s, x, r):
    """Multiply the vectors in three rows from x on by the matrix r."""
    y, z = x + BLOCK, x + 2 * BLOCK
    for i in range(BLOCK):
        a, b, c = s[x + i], s[y + i], s[z + i]
        s[x + i] = r[0, 0] * a + r[0, 1] * b + r[0, 2] * c
        s[y + i] = r[1, 0] * a + r[1, 1] * b + r[1, 2] * c
        s[z + i] = r[2, 0] * a + r[2, 1] * b + r[2, 2] * c
