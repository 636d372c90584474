"""Convergence of designs: test for a local optimum, and loss of the frozen classifier compared with other lenses.

A lens is at a local optimum of its criterion if no small step within its limits lowers the loss. Such a lens can still
have a larger loss than another lens of the same elements. This difference is its optimality gap, by the loss of the
classifier on the minival images before any fine-tuning.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_ERRORS = 2.0  # paired standard errors within which losses count as equal
_NEGLIGIBLE = 0.002  # gains up to this count as none; losses are about 1


@dataclass(frozen=True)
class Optimum:
    """Test for a local optimum, from a lens file (see `design.optimum`).

    Attributes:
        gain: largest mean decrease of the loss by one of the steps; negative if all raise it.
        error: standard error of the gain, paired by image.
        step_um: RMS ray displacement of that step [um].
        along: direction of that step.
        images: number of images; 0 for a loss of rays or PSFs.
    """

    gain: float
    error: float
    step_um: float
    along: str
    images: int

    @property
    def reached(self) -> bool:
        """True if the gain is at most twice its standard error plus 0.002."""
        return self.gain <= _ERRORS * self.error + _NEGLIGIBLE

    def __str__(self) -> str:
        return f"{self.gain:+.4f} +- {self.error:.4f}, {self.step_um:g} um, {self.along}"


def optimum(content: Mapping[str, Any]) -> Optimum | None:
    """Return the test for a local optimum in a lens file; None for designs without captures or PSFs."""
    test = content.get("local_optimum")
    return None if test is None else Optimum(**test)
