"""Blocks of rays for the compiled tracer: arrays that stay in the cache, in loops that become vector instructions.

A block is one flat array. Its rows, with the names below, hold one number for each of BLOCK rays. With this layout the
compiler knows that rows do not overlap, and turns a loop over a row into vector instructions.
"""

import hashlib
import os
from pathlib import Path
from typing import Any

import numba
from llvmlite.binding import get_host_cpu_features

BLOCK = 128  # rays
GROUP = 16 * BLOCK  # rays whose gradients are summed together, for any number of threads
CHUNK = 8  # orders of an asphere that are evaluated in registers; coefficients are padded to a multiple
ROWS = 25
# The ray: position, direction and optical path; in derivatives their change or gradient.
X, Y, Z, L, M, N, PATH = range(0, 7 * BLOCK, BLOCK)
# The direction behind the surface; mu and the index in front; the distance t, and u at the surface
L_OUT, M_OUT, N_OUT, MU, INDEX, T, U = range(7 * BLOCK, 14 * BLOCK, BLOCK)
# w = 1 / sqrt(1 - (1 + k) c^2 u), e and b of `refraction`, and the three polynomials of the surface
W, E, B, VALUE, SLOPE, CURVING = range(14 * BLOCK, 20 * BLOCK, BLOCK)
# For an intersection: u = A0 + 2 B0 t + C0 t^2; whether the ray meets the surface; the largest u on its way there
A0, B0, C0, MEETS, WIDEST = range(20 * BLOCK, 25 * BLOCK, BLOCK)
PASSES, GOES_ON = A0, B0  # for a refraction: the aperture lets the ray pass; the ray is not reflected
POWER = A0  # for gradients: u^(j - 1)

# Columns of the table of surfaces: c, (1 + k) c^2, distance to the next vertex, largest u of the clear aperture, and
# the u up to which no slope exceeds 1, infinite for a plane
CURVATURE, BENDING, THICKNESS, LIMIT, GENTLE = range(5)
COLUMNS = 5
VALUES, SLOPES, CURVINGS = range(3)  # polynomials of a surface: alpha_2j, j alpha_2j and j (j - 1) alpha_2j


def _cache_folder() -> Path:
    """Return the folder of compiled code, one per version of all these modules: numba checks only a single file."""
    text = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "tasklens" / hashlib.sha256(text).hexdigest()[:16]


numba.config.CACHE_DIR = str(_cache_folder())
_HOST = get_host_cpu_features()
if numba.config.CPU_FEATURES is None and _HOST.get("avx512f"):  # the default uses half of its width and is 10 % slower
    numba.config.CPU_FEATURES = _HOST.flatten() + ",-prefer-256-bit"
# The compiler may contract products and sums, but reorders only the sums of `add`. Functions that an entry calls are
# always inlined: a separate function has different machine code when it is newly compiled and when it is cached.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
entry = numba.njit(cache=True, **_OPTIONS)
inlined = numba.njit(forceinline=True, **_OPTIONS)


@numba.njit(forceinline=True, fastmath={"contract", "reassoc", "nsz"})
def add(total, value):
    """Add to a sum over rays, in any order."""
    return total + value


@inlined
def horner(s, row, coefficients):
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


@inlined
def load(s, start, block, size):
    """Load rays into a block, and fill it up with rays on the axis."""
    for row in range(7):
        for i in range(size):
            s[row * BLOCK + i] = start[row, block + i]
        for i in range(size, BLOCK):
            s[row * BLOCK + i] = row == 5


@inlined
def fill_colours(first, count, colours):
    """Fill `colours` with the wavelength index of each ray of a block; last entry: 2 if several wavelengths, else 1."""
    waves, per_wave = count
    k, remaining = (first // per_wave) % waves, per_wave - first % per_wave
    colours[BLOCK] = 2 if remaining < BLOCK and waves > 1 else 1
    for i in range(BLOCK):
        colours[i] = k
        remaining -= 1
        if remaining == 0:
            remaining = per_wave
            k = k + 1 if k + 1 < waves else 0


@inlined
def fill_media(s, colours, index, behind):
    """Fill the rows of the index in front of a surface and of mu from the indices (W,) of each colour."""
    before, mu = index[colours[0]], index[colours[0]] / behind[colours[0]]
    for i in range(BLOCK):
        s[INDEX + i], s[MU + i] = before, mu
    for i in range(BLOCK if colours[BLOCK] > 1 else 0):
        k = colours[i]
        s[INDEX + i], s[MU + i] = index[k], index[k] / behind[k]
