"""Clear apertures of a design: open while its surfaces move, set when it is done."""

from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.lens import Lens


def with_open_apertures(lens: Lens) -> Lens:
    """Return the lens without clear apertures except the stop."""
    semi_diameter = torch.full_like(lens.semi_diameter, torch.inf)
    semi_diameter[lens.stop] = lens.semi_diameter[lens.stop]
    return replace(lens, semi_diameter=semi_diameter)


def with_clear_apertures(lens: Lens, clear: Tensor) -> Lens:
    """Set clear apertures of semi-diameters `clear` (S,) [mm] on surfaces that have none.

    They vignette stray rays: task-driven lenses have strongly curved rims, where a few rim rays have large errors.
    """
    return replace(lens, semi_diameter=torch.where(lens.semi_diameter.isinf(), clear, lens.semi_diameter))
