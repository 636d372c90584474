"""Monte Carlo of manufacture: lenses built with random errors, and tolerances with which enough of them are good.

Tolerances for a drawing are loose for errors with little effect.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from tasklens.optics.analysis import focus
from tasklens.optics.lens import Lens
from tasklens.optics.tolerancing.manufacturing_errors import Error, with_errors
from tasklens.optics.view import View

YIELD = 0.95  # fraction of the lenses that must be good
TRIED = 100  # largest number of lenses that are simulated with each set of tolerances
SEED = 7001  # added to the seed: these lenses differ from the reported ones
_LOOSEST = 4.0  # times the tolerance of the grade: looser ones save nothing
_RANGE = (1 / 32, 8.0)  # range of the common factor
_HALVINGS = 5  # of the logarithm of the range: the factor is within 19 %
TRIALS = 1 + _HALVINGS  # largest number of calls of `passes` in `widest`


@dataclass(frozen=True)
class MonteCarlo:
    """Lenses built from a design, each focused to the design's distance from its MTF peak; differentiable in it.

    Attributes:
        lens: the design.
        view: fields, wavelengths and pixels of the focus.
        errors: P errors of a built lens.
    """

    lens: Lens
    view: View
    errors: Sequence[Error]

    @cached_property
    def peak(self) -> Tensor:
        """Distance of the peak of the design's MTF from its image plane [mm]."""
        return focus.peak(self.lens, self.view)

    def build(self, fractions: Tensor) -> tuple[Lens, Tensor]:
        """Build a lens with errors (P,) [fractions of tolerances]; return it focused, and its focus shift [mm]."""
        lens = with_errors(self.lens, self.errors, fractions, self.view.reference_um)
        shift = focus.peak(lens, self.view) - self.peak
        return focus.move_image_plane(lens, shift), shift

    def enough_are_good(self, draws: Tensor, tolerances: Tensor, is_good: Callable[[Lens], bool]) -> bool:
        """Return whether a fraction `YIELD` of lenses is good.

        Args:
            draws: (count, P) errors of the lenses [fractions of tolerances].
            tolerances: (P,) tolerances as multiples of the grade's.
            is_good: the test of a built lens.
        """
        bad = 0
        for fractions in draws:
            bad += not is_good(self.build(tolerances * fractions)[0])
            if bad > (1 - YIELD) * len(draws):
                return False
        return True


def both_axes(errors: Sequence[Error], displacements: Tensor) -> Tensor:
    """Replace displacements (P,) of a decentre or tilt in x and y by their RMS: drawings have a single tolerance."""
    squares: dict[tuple[str, int, str], list[float]] = {}
    names = [(error.kind, error.surface, error.part.strip("xy")) for error in errors]
    for name, displacement in zip(names, displacements.tolist(), strict=True):
        squares.setdefault(name, []).append(displacement**2)
    return torch.tensor([(sum(squares[name]) / len(squares[name])) ** 0.5 for name in names], dtype=displacements.dtype)


def cheapest(displacements: Tensor, factor: float) -> Tensor:
    """Return the tolerances (P,) of least cost for their mean square displacement, as multiples of the grade's.

    The cost is the sum over errors of the tolerance of the grade divided by the allotted one. By a Lagrange multiplier
    it is least for t = factor (s / rms(s))^(-2/3), with s the displacement by an error as large as the tolerance of the
    grade.

    Args:
        displacements: (P,) s [um].
    """
    relative = displacements / displacements.square().mean().sqrt().clamp(min=1e-12)
    return (factor * relative.clamp(min=1e-9) ** (-2 / 3)).clamp(max=_LOOSEST)


def widest(displacements: Tensor, passes: Callable[[Tensor], bool]) -> Tensor | None:
    """Find the widest tolerances (P,) that pass, as multiples of the grade's, by bisection of their common factor.

    Args:
        passes: returns whether enough lenses with the tolerances (P,) are good.

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


def error_rows(
    errors: Sequence[Error], allotted: Tensor | None, **columns: Sequence[float | None]
) -> list[dict[str, Any]]:
    """Return a row per error: its name, unit and tolerance, `columns`, and the allotted tolerance in the same unit.

    Args:
        errors: P errors of a lens.
        allotted: (P,) tolerances for a drawing, as multiples of the grade's; None if none suffice.
        columns: P values each, by name.
    """
    return [
        {
            "error": error.name,
            "unit": error.unit,
            "tolerance": error.tolerance,
            **{name: values[k] for name, values in columns.items()},
            "allotted": None if allotted is None else error.tolerance * float(allotted[k]),
        }
        for k, error in enumerate(errors)
    ]
