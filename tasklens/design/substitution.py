"""Choice of materials: a brief least-squares design for each combination; the sharpest lens decides."""

import itertools
import math
from collections.abc import Callable, Sequence

from tasklens.runtime.errors import InputError
from tasklens.runtime.progress import Progress

ALTERNATIVE = "|"  # separates the alternative materials of an element
_MOST = 1000  # largest number of combinations


def combinations(elements: Sequence[str]) -> list[tuple[str, ...]]:
    """Return all combinations of the materials of elements, such as COC|PMMA, OKP4|PC; raises InputError."""
    choices = [list(dict.fromkeys(element.split(ALTERNATIVE))) for element in elements]
    if (count := math.prod(map(len, choices))) > _MOST:
        raise InputError(f"elements: {count} combinations of materials; expected at most {_MOST}")
    return list(itertools.product(*choices))


def covering(elements: Sequence[str]) -> list[tuple[str, ...]]:
    """Return a few combinations in which every material of every element occurs; raises InputError."""
    combinations(elements)
    choices = [element.split(ALTERNATIVE) for element in elements]
    return [tuple(options[k % len(options)] for options in choices) for k in range(max(map(len, choices)))]


def sharpest(
    elements: Sequence[str], spot: Callable[[tuple[str, ...]], float]
) -> tuple[tuple[str, ...], dict[str, float]]:
    """Try all combinations of materials.

    Args:
        elements: materials of each element, with `ALTERNATIVE` between them.
        spot: function from materials to the mean RMS spot radius of a brief design [um].

    Returns:
        The combination of the smallest spot, and the spots of all combinations by name, in ascending order.
    """
    choices = combinations(elements)
    progress = Progress("materials", len(choices))
    spots: dict[tuple[str, ...], float] = {}
    for step, materials in enumerate(choices, 1):
        spots[materials] = spot(materials)
        progress(step, rms_um=min(spots.values()))
    order = sorted(spots, key=lambda materials: spots[materials])
    return order[0], {",".join(materials): spots[materials] for materials in order}
