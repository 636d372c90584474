"""How step sizes change over a design."""

import math


def cosine(fraction: float, final: float) -> float:
    """Factor on a rate after `fraction` of the steps: from 1 to `final` on half a cosine."""
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(fraction, 1.0)))
