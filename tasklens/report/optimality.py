"""Optimality gap of task-driven lenses: the frozen classifier's loss beside that of the other lenses.

A descent on the classifier's loss that ends above the loss of another lens of the same elements has not converged, and
shows nothing about the task. The loss is of the classifier before any fine-tuning, on the minival images.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import pandas

_ERRORS = 2.0  # paired standard errors within which the loss counts as the least
_SAME = 1e-4  # difference of losses below which two lenses are one, such as a design and a candidate that it returned


@dataclass(frozen=True)
class Gap:
    """Optimality gap of a lens.

    Attributes:
        nearest: name of the other lens with the least mean loss.
        difference: mean loss less that of `nearest`; negative where the lens is the best.
        error: standard error of the difference, paired by image.
    """

    nearest: str
    difference: float
    error: float

    @property
    def converged(self) -> bool:
        """True if the loss is the least, or not above it by more than twice the standard error and 1e-4."""
        return self.difference <= _ERRORS * self.error + _SAME


def gap(loss: pandas.Series, others: Mapping[str, pandas.Series]) -> Gap:
    """Compute the gap between the losses of a lens, a value per image, and the least of `others` by name."""
    nearest = min(others, key=lambda name: float(others[name].mean()))
    difference = loss - others[nearest]
    return Gap(nearest, float(difference.mean()), float(difference.std(ddof=1)) / math.sqrt(len(difference)))
