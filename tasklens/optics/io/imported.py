"""Imported lenses: the specification sets size, stop and focus; the file sets the rest."""

import math
from dataclasses import replace

import torch

from tasklens.optics.analysis.focus import refocused
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import rim
from tasklens.optics.analysis.spots import chief_rays, trace_fields
from tasklens.optics.io import prescription, zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.io.stop import stop_radius
from tasklens.optics.lens import Lens
from tasklens.optics.rays import describe_loss
from tasklens.optics.view import View
from tasklens.runtime.files import FileError
from tasklens.study.lens_entries import ImportedLens


def fit(settings: ImportedLens, view: View, f_number: float, rays: int) -> tuple[Lens, dict]:
    """Read a lens and fit it to a specification.

    The lens is scaled to the focal length of `view`, its stop is set to the F-number, and it is refocused for the
    object of `view`. Its clear apertures are scaled with it and vignette.

    Args:
        settings: file of the lens.
        view: fields, wavelengths and focal length.
        f_number: focal length over diameter of the entrance pupil.
        rays: number of pupil points per field and wavelength for the focus.

    Returns:
        The lens, and its origin: the file with its EFL [mm] and object distance [mm, None = infinity], the scale, the
        shift of the image plane after scaling [mm], and assumptions made when the file was read, as text.

    Raises:
        FileError: the file cannot be read, or its lens does not fit the specification.
    """
    name = str(settings.file)
    source = read(settings)
    try:
        source.lens.refractive_indices(view.wavelengths_um)
    except ValueError as error:
        raise FileError(f"{name}: {error}") from None
    efl = float(paraxial(source.lens, view.reference_um).efl)
    if not 0 < efl < math.inf:
        raise FileError(f"{name}: focal length {efl:.4g} mm: expected a positive one")
    scale = view.efl / efl
    lens = source.lens.scaled(scale)
    lens.semi_diameter[lens.stop] = stop_radius(lens, ("f_number", f_number), view.reference_um)
    _check_light(lens, view, f_number, name)
    focused = refocused(lens, view, rays)
    return focused, {
        "file": name,
        "file_efl_mm": efl,
        "file_object_distance_mm": None if math.isinf(source.object_distance_mm) else source.object_distance_mm,
        "scale": scale,
        "image_plane_shift_mm": float(focused.thickness[-1] - lens.thickness[-1]),
        **({"assumptions": list(source.remarks)} if source.remarks else {}),
    }


def read(settings: ImportedLens) -> Prescription:
    """Read the prescription from the file of an imported lens; raises FileError."""
    if settings.file.suffix.lower() == ".zmx":
        return zemax.read(settings.file, settings.catalogues)
    return prescription.read(settings.file)[0]


def _check_light(lens: Lens, view: View, f_number: float, name: str) -> None:
    """Check that no ray of the axial beam, which fills the stop, and no chief ray is lost; raises FileError."""
    on_axis = replace(view.in_reference(), fields=torch.zeros(1, 2, dtype=view.fields.dtype))
    beam = trace_fields(lens, on_axis, rim(64))
    if not beam.valid.all():
        where = describe_loss(beam, ~beam.valid)
        raise FileError(f"{name}: not fast enough for F/{f_number:g}: a marginal ray on the axis is lost {where}")
    chief = chief_rays(lens, view)
    if not chief.valid.all():
        field = int((~chief.valid).flatten().nonzero()[0])
        angle = math.degrees(math.atan(float(view.radii[field]) / view.efl))
        where = describe_loss(chief, ~chief.valid)
        raise FileError(f"{name}: does not cover the field: at {angle:.1f} degrees the chief ray is lost {where}")
