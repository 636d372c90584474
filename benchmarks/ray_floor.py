"""The least time in which a processor can do the operations of rays at aspheres."""

import math
from collections.abc import Callable
from functools import cache

import numba
import numpy
import torch
from timing import alternate

# Operations of a ray at an asphere of M orders: multiply-adds, square roots and divisions. A step of Newton's iteration
# (two in float32, three in float64), the refraction, and the gradient, which traces the ray again.
_NEWTON = (lambda orders: 2 * orders + 22, 1, 1)
_REFRACTION = (lambda orders: orders + 35, 2, 2)
_GRADIENT = (lambda orders: 4 * orders + 110, 2, 5)


def floor(dtype: torch.dtype, rays: int, aspheres: int) -> tuple[float, float]:
    """Least time [s] of the operations of rays at aspheres, forward, and forward and backward, on this processor.

    Each kind of operation runs at the rate of a loop of that operation alone over numbers in the first cache. Divisions
    and square roots share a unit that works in parallel with the multiply-adds: the larger of the two times counts.
    """
    multiply_add, root, division = _rates(dtype)
    orders = 8  # coefficients are padded to eight
    steps = 2 if dtype == torch.float32 else 3

    def least(*parts: tuple) -> float:
        adds = sum(part[0](orders) for part in parts) * multiply_add
        return max(adds, sum(part[1] * root + part[2] * division for part in parts)) * rays * aspheres

    forward = (*[_NEWTON] * steps, _REFRACTION)
    return least(*forward), least(*forward, _GRADIENT)


@cache
def _rates(dtype: torch.dtype) -> tuple[float, float, float]:
    """Seconds of a multiply-add, a square root and a division of one number among vectors."""
    compiled = numba.njit(error_model="numpy", fastmath={"contract"})

    @compiled
    def multiply_adds(x, a, count):
        a0, a1, a2, a3 = a[0], a[1], a[2], a[3]
        for _ in range(count):
            for i in range(128):
                u = x[i]
                v = (((u * u + a0) * u + a1) * u + a2) * u + a3
                v = (((v * u + a0) * u + a1) * u + a2) * u + a3
                v = (((v * u + a0) * u + a1) * u + a2) * u + a3
                x[128 + i] = (((v * u + a0) * u + a1) * u + a2) * u + a3

    @compiled
    def roots(x, a, count):
        for _ in range(count):
            for i in range(128):
                x[i] = math.sqrt(x[i])

    @compiled
    def divisions(x, a, count):
        for _ in range(count):
            for i in range(128):
                x[i] = a[0] / x[i]

    def rate(function: Callable, operations: int) -> float:
        x, a, count = numpy.full(256, 0.9, str(dtype)[6:]), numpy.ones(4, str(dtype)[6:]), 2000
        times = alternate({"": lambda: function(x, a, count)}, 15)[""]
        return min(times) / (128 * count * operations)

    return rate(multiply_adds, 16), rate(roots, 1), rate(divisions, 1)
