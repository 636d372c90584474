"""Remarks on light that a lens from a file loses."""

import math
from dataclasses import replace

import torch

from tasklens.optics.analysis.pupil import rim
from tasklens.optics.analysis.spots import chief_rays, has_light, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import describe_loss
from tasklens.optics.view import View

_RIM = 64  # marginal rays on the axis


def light_remarks(lens: Lens, view: View) -> list[str]:
    """Return remarks on marginal rays lost on the axis, and on fields of which the chief ray or no light arrives."""
    view = view.in_reference()
    chief = chief_rays(lens, view)
    light = has_light(lens, view)
    remarks = []
    on_axis = replace(view, fields=torch.zeros_like(view.fields[:1]))
    beam = trace_fields(lens, on_axis, rim(_RIM))
    if light.all() and not beam.valid.all():
        where = describe_loss(beam, ~beam.valid)
        remarks.append(f"marginal rays on the axis are lost {where}: the F-number is that of the stop alone")
    for arrives, effect in (
        (light, "no light arrives"),
        (chief.valid[:, 0, 0] | ~light, "the chief ray does not arrive"),
    ):
        if not arrives.all():
            angle = math.degrees(math.atan(float(view.radii[~arrives].min()) / view.efl))
            count = f"{int((~arrives).sum())} of {len(light)} fields, from {angle:.1f} degrees on"
            lost = ~chief.valid & ~arrives[:, None, None]
            reason = f": it is lost {describe_loss(chief, lost)}" if lost.any() else ""
            remarks.append(f"{effect} at {count}{reason}")
    return remarks
