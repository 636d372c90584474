"""How step sizes, pixels and stops change over a design."""

import math


def cosine(fraction: float, final: float) -> float:
    """Factor on a rate after `fraction` of the steps: from 1 to `final` on half a cosine."""
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(fraction, 1.0)))


def geometric(start: float, fraction: float) -> float:
    """A scale that goes from `start` to 1 in equal ratios while `fraction` goes from 0 to 1, and stays there."""
    return start ** max(0.0, 1 - fraction)
