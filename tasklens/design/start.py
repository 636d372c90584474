"""Flat plates as the starting lens of designs."""

import torch

from tasklens.design.variables import ORDERS
from tasklens.materials.material import AIR, Material
from tasklens.optics.lens import Lens
from tasklens.settings.specification import Constraints, Spec

_BACK = 0.35  # last space [focal lengths], if there is room; small: far from the stop, fields separate on the plates
_AIR = 0.5  # air spaces [plate thicknesses]


def flat(plastics: tuple[Material, ...], spec: Spec, constraints: Constraints) -> Lens:
    """Return plane-parallel plates behind a stop, a lens without power."""
    plates = len(plastics) + _AIR * (len(plastics) - 1)  # with the air between them [plate thicknesses]
    room = constraints.flat_track * spec.efl_mm - constraints.stop_distance
    last = min(_BACK * spec.efl_mm, room - plates * constraints.min_centre_thickness)
    back = max(last, constraints.min_back_focus)
    plate = (room - back) / plates
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
