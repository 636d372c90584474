"""Where a design that stopped being finite did so."""

import torch
from torch import Tensor

from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.view import View


def cause(lens: Lens, view: View, pupil: Tensor, losses: Tensor) -> str:
    """The first field whose loss is not finite, and the first surface at which the lens or its rays are not.

    Args:
        lens: the lens of the step.
        pupil: (N, 2) its rays.
        losses: (F,) of the fields.
    """
    broken = (~torch.isfinite(losses)).nonzero()[:, 0].tolist()
    field = "no field"
    if broken:
        x, y = view.fields[broken[0]].tolist()
        field = f"field {broken[0]} at ({x:.3f}, {y:.3f}) mm"
    return f"{field}; {_surface(lens.detached(), view, pupil)}"


def _surface(lens: Lens, view: View, pupil: Tensor) -> str:
    for i, numbers in enumerate(zip(lens.curvature, lens.thickness, lens.alpha, strict=True)):
        if not all(torch.isfinite(number).all() for number in numbers):
            return f"surface {i} has a shape that is not finite"
    record: list = []
    trace_fields(lens, view, pupil, record)
    for i, rays in enumerate(record):
        if any(not torch.isfinite(value[rays.lost_at < 0]).all() for value in (rays.x, rays.y, rays.l, rays.m, rays.n)):
            return f"rays stop being finite at surface {i}"
    return "all surfaces and rays are finite, the network or a limit is not"
