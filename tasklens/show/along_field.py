"""Figures of a lens along its field, from the axis to the corner."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tasklens.optics.analysis.aberrations import field_curvature
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_rays, chief_scale, distortion, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View

_FIELDS = 21
_RAYS = 1024  # per field and wavelength


@dataclass(frozen=True)
class AlongField:
    """Figures of a lens at F fields from the axis to the corner; NaN where the chief ray is lost.

    Attributes:
        angles: (F,) field angles [degrees].
        view: the fields along +y.
        rays: rays of the fields on the image plane.
        tangential: (F,) tangential focus, along z from the image plane [um].
        sagittal: (F,) sagittal focus.
        distortion: (F,) distortion [%].
    """

    angles: Tensor
    view: View
    rays: Rays
    tangential: Tensor
    sagittal: Tensor
    distortion: Tensor


def along_field(lens: Lens, view: View) -> AlongField:
    """Compute the figures of a lens along its field."""
    heights = torch.linspace(0, 1, _FIELDS, dtype=view.fields.dtype) * view.radii.max()
    view = view.along_y(heights)
    chief = chief_rays(lens, view)
    arrives = chief.valid[:, 0, 0]
    points = torch.cat([chief.x[:, 0], chief.y[:, 0]], -1)
    tangential, sagittal = field_curvature(lens, view)
    percent = 100 * distortion(view.fields * chief_scale(lens, view), points)
    return AlongField(
        angles=torch.rad2deg(torch.atan(heights / view.efl)),
        view=view,
        rays=trace_fields(lens, view, sobol_disc(_RAYS, seed=0)),
        tangential=1e3 * tangential,
        sagittal=1e3 * sagittal,
        distortion=torch.where(arrives, percent, torch.nan),
    )
