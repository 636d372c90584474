"""Flat plates as the starting lens of designs."""

import torch

from tasklens.design.variables import ORDERS
from tasklens.materials.material import AIR, Material
from tasklens.optics.lens import Lens
from tasklens.study.settings import Constraints, Spec

_BACK = 0.35  # last space [focal lengths]; small, since fields are separated on plates far from the stop
_AIR = 0.5  # air spaces [plate thicknesses]


def flat(plastics: tuple[Material, ...], spec: Spec, constraints: Constraints) -> Lens:
    """Return plane-parallel plates behind a stop, a lens without power."""
    elements = len(plastics)
    back = max(_BACK * spec.efl_mm, constraints.min_back_focus)
    room = constraints.flat_track * spec.efl_mm - constraints.stop_distance - back
    plate = room / (elements + _AIR * (elements - 1))
    media, thickness = [AIR], [constraints.stop_distance]
    for plastic in plastics:
        media += [plastic, AIR]
        thickness += [plate, _AIR * plate]
    thickness[-1] = back
    surfaces = len(media)
    zeros = torch.zeros(surfaces, dtype=torch.float64)
    semi_diameter = torch.full_like(zeros, torch.inf)
    semi_diameter[0] = spec.stop_radius_mm
    return Lens(
        curvature=zeros,
        conic=zeros.clone(),
        alpha=torch.zeros(surfaces, ORDERS[-1] // 2, dtype=torch.float64),
        thickness=torch.tensor(thickness, dtype=torch.float64),
        semi_diameter=semi_diameter,
        media=tuple(media),
        stop=0,
    )
