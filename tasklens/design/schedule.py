"""Schedules of step sizes, learning rates, pixels and stops."""

import math


def cosine(fraction: float, final: float) -> float:
    """Compute the factor on a rate after `fraction` of the steps: half a cosine from 1 to `final`."""
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(fraction, 1.0)))


def geometric(start: float, fraction: float) -> float:
    """Compute a scale that changes geometrically from `start` at fraction 0 to 1 at fraction 1, and then stays 1."""
    return start ** max(0.0, 1 - fraction)
