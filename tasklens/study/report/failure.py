"""Rule for a failed design: too little energy inside the PSF window, or too little accuracy."""

from typing import TypeVar

import pandas

LEAST_ENERGY = 0.5  # inside the PSF window, mean over fields
_Accuracy = TypeVar("_Accuracy", float, pandas.DataFrame)


def least_accuracy(sharp: _Accuracy, chance: float) -> _Accuracy:
    """Return the least accuracy [%] of a design that did not fail: half-way between chance and sharp images."""
    return (sharp + chance) / 2


def failed(accuracy: float, sharp: float, chance: float, energy_in_window: float) -> bool:
    """Return whether a design failed: too little energy or, with a fine-tuned classifier, too little accuracy.

    Args:
        accuracy, sharp, chance: accuracy on the captures, on sharp images, and by guessing [%].
    """
    return not (energy_in_window >= LEAST_ENERGY and accuracy >= least_accuracy(sharp, chance))
