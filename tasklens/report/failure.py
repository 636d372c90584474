"""The rule by which a design failed: energy inside the PSF window, and accuracy."""

from typing import TypeVar

import pandas

LEAST_ENERGY = 0.5  # inside the PSF window, mean over fields
_Accuracy = TypeVar("_Accuracy", float, pandas.DataFrame)


def least_accuracy(sharp: _Accuracy, chance: float) -> _Accuracy:
    """Return the least accuracy [%] of a design that did not fail: half-way from chance to that on sharp images."""
    return (sharp + chance) / 2


def failed(accuracy: float, sharp: float, chance: float, energy_in_window: float) -> bool:
    """Return whether a design failed: it lacks the least energy or, with a fine-tuned classifier, the least accuracy.

    Args:
        accuracy, sharp, chance: accuracy on the captures, on sharp images, and by guessing [%].
    """
    return not (energy_in_window >= LEAST_ENERGY and accuracy >= least_accuracy(sharp, chance))
