"""The fields of a prescription as direction tangents, from angles, object heights or image heights."""

import math
from dataclasses import replace

import torch
from scipy.optimize import brentq
from torch import Tensor

from tasklens.optics.analysis.object_points import image_scale
from tasklens.optics.analysis.spots import chief_rays
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError

_EDGE_STEPS = 20  # bisections between a chief ray that arrives and one that is lost
_FIELD = "give the full field of view in degrees: --field-of-view, in Python field_of_view_deg"


def field_tangents(prescription: Prescription, efl: float, pupil_z: float, wavelength: float) -> Tensor:
    """Compute the direction tangents (F, 2) of the fields of a prescription, as seen from the entrance pupil.

    For a field angle they are (tan x, tan y). For an object height h the tangent is that of the chief ray,
    h / (distance to the entrance pupil). For a paraxial image height it is h / (f k), with k from `image_scale`. For a
    real image height it is the tangent of the chief ray that arrives there.

    Raises:
        InputError: the prescription has no fields, or fields that need a near object, or no chief ray arrives.
    """
    if prescription.fields is None:
        raise InputError(f"has neither a spec nor fields; {_FIELD}")
    kind, points = prescription.fields
    near = math.isfinite(prescription.object_distance_mm)
    fields = torch.tensor(points, dtype=torch.float64)
    if kind == "angle_deg":
        if (widest := float(fields.abs().max())) >= 90:
            raise InputError(f"a field of {widest:g} degrees: expected less than 90; {_FIELD}")
        return torch.tan(torch.deg2rad(fields))
    view = View(torch.zeros(1, 2, dtype=torch.float64), efl, (wavelength,), 1.0, 3, 1 / prescription.object_distance_mm)
    if kind == "object_height_mm" and near:
        return fields / (prescription.object_distance_mm + pupil_z)
    if kind == "paraxial_image_height_mm":
        return fields / (efl * abs(float(image_scale(prescription.lens, view))))
    if kind == "real_image_height_mm":
        heights = fields.norm(dim=1).tolist()
        tangents = {height: _tangent_of_image_height(prescription.lens, view, height) for height in {*heights} - {0.0}}
        ratios = [tangents[height] / height if height else 0.0 for height in heights]
        return fields * torch.tensor(ratios, dtype=torch.float64)[:, None]
    raise InputError(f"fields by {kind.replace('_', ' ')} and an object at infinity have no angle; {_FIELD}")


def _tangent_of_image_height(lens: Lens, view: View, height: float) -> float:
    """Compute the tangent of the least field whose chief ray meets the image plane at `height` [mm].

    Clear apertures are ignored: they may stop the ray, but do not change its path.

    Raises:
        InputError: no chief ray arrives at this height.
    """
    unclipped = lens.with_open_apertures()

    def beyond(*tangents: float) -> list[float]:
        """Return how far the chief rays arrive beyond `height` [mm]; NaN for lost rays."""
        fields = torch.tensor([[0.0, tangent * view.efl] for tangent in tangents], dtype=torch.float64)
        ray = chief_rays(unclipped, replace(view, fields=fields))
        return torch.where(ray.valid, ray.y.abs() - height, torch.nan).flatten().tolist()

    steps = [math.tan(math.radians(half_degrees / 2)) for half_degrees in range(1, 180)]
    low = 0.0
    # One by one for a near object, which may not be as wide as the last ones.
    for tangents in [[tangent] for tangent in steps] if view.object_vergence else [steps]:
        for high, excess in zip(tangents, beyond(*tangents), strict=True):
            lost = math.isnan(excess)
            for _ in range(_EDGE_STEPS if lost else 0):  # to the last chief ray that arrives
                middle = (low + high) / 2
                if (excess := beyond(middle)[0]) >= 0:
                    high = middle
                    break
                low, high = (low, middle) if math.isnan(excess) else (middle, high)
            if excess >= 0:
                return float(brentq(lambda tangent: beyond(tangent)[0], low, high))
            if lost:
                raise InputError(f"no chief ray arrives at the image height {height:g} mm of the file; {_FIELD}")
            low = high
    raise InputError(f"no chief ray arrives at the image height {height:g} mm of the file; {_FIELD}")
