"""Allocation of tolerances to the errors of a lens: loose where they cost little, so that most lenses are good."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from tasklens.optics.tolerancing.errors import Error

YIELD = 0.95  # share of the lenses that tolerances are allotted for
TRIED = 100  # lenses that are built with each set of tolerances, at most
SEED = 7001  # added to the seed: other lenses than those that are reported
_LOOSEST = 4.0  # times the tolerance of the grade: looser ones save nothing
_RANGE = (1 / 32, 8.0)  # of the common factor
_HALVINGS = 5  # of the logarithm of the range: the factor is within 19 %
TRIALS = 1 + _HALVINGS  # of `widest`, at most


def both_axes(found: Sequence[Error], displacements: Tensor) -> Tensor:
    """Return displacements (P,) in which x and y of a decentre or tilt are alike, their RMS: drawings have one."""
    squares: dict[tuple[str, int, str], list[float]] = {}
    names = [(error.kind, error.surface, error.part.strip("xy")) for error in found]
    for name, moved in zip(names, displacements.tolist(), strict=True):
        squares.setdefault(name, []).append(moved**2)
    return torch.tensor([(sum(squares[name]) / len(squares[name])) ** 0.5 for name in names], dtype=displacements.dtype)


def cheapest(displacements: Tensor, factor: float) -> Tensor:
    """Return tolerances (P,) over those of the grade, at the least cost for their mean square displacement.

    With a cost that is the tolerance of the grade over that allotted, summed over errors, cost is least for tolerances
    t = factor (s / rms(s))^(-2/3) (Lagrange), s the displacement by an error of the size of the grade's tolerance.

    Args:
        displacements: (P,) s [um].
    """
    relative = displacements / displacements.square().mean().sqrt().clamp(min=1e-12)
    return (factor * relative.clamp(min=1e-9) ** (-2 / 3)).clamp(max=_LOOSEST)


def widest(displacements: Tensor, passes: Callable[[Tensor], bool]) -> Tensor | None:
    """Find the widest tolerances (P,) over those of the grade that pass, by bisection of their common factor.

    Args:
        passes: whether enough lenses with these tolerances (P,) are good.

    Returns:
        None if even the tightest do not pass.
    """
    least, high = torch.log2(torch.tensor(_RANGE)).tolist()
    low = least
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if passes(cheapest(displacements, 2**middle)) else (low, middle)
    if low == least and not passes(cheapest(displacements, 2**low)):
        return None
    return cheapest(displacements, 2**low)
