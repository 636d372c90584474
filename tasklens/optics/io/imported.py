"""Imported lenses: the specification sets size, stop and focus; the file sets the rest."""

import math
from collections.abc import Mapping
from typing import Any

from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.spots import axial_beam, chief_rays
from tasklens.optics.io import prescription, zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.io.stop import stop_radius
from tasklens.optics.lens import Lens
from tasklens.optics.rays import describe_loss
from tasklens.optics.view import View
from tasklens.runtime.files import FileError
from tasklens.settings.lens_entries import ImportedLens

_SAME = 1e-9  # relative difference of equal focal lengths or vergences


def fit(settings: ImportedLens, view: View, f_number: float) -> tuple[Lens, dict]:
    """Read a lens and fit it to a specification.

    The lens is scaled to the focal length of `view` with its image plane, and its stop is set to the F-number. Its
    clear apertures are scaled with it and vignette.

    Args:
        settings: file of the lens.
        view: fields, wavelengths and focal length.
        f_number: focal length over diameter of the entrance pupil.

    Returns:
        The lens, and its origin: the file with its EFL [mm] and object distance [mm, None = infinity], the scale,
        what sets its `focus`, and assumptions made when the file was read. Its image plane is still that of the file.

    Raises:
        FileError: the file cannot be read, or its lens does not fit the specification.
    """
    name = str(settings.file)
    source, spec = read(settings)
    try:
        source.lens.refractive_indices(view.wavelengths_um)
    except ValueError as error:
        raise FileError(f"{name}: {error}") from None
    efl, own_f_number = size(source.lens, spec, view.reference_um)
    if not 0 < efl < math.inf:
        raise FileError(f"{name}: focal length {efl:.4g} mm: expected a positive one")
    same_size = math.isclose(view.efl, efl, rel_tol=_SAME)
    scale = 1.0 if same_size else view.efl / efl
    lens = source.lens.scaled(scale)
    if not math.isclose(f_number, own_f_number, rel_tol=_SAME):
        lens = lens.with_stop_radius(stop_radius(lens, ("f_number", f_number), view.reference_um))
    _check_light(lens, view, f_number, name)
    same_object = math.isclose(source.object_distance_mm, view.object_distance, rel_tol=_SAME)
    return lens, {
        "file": name,
        "file_efl_mm": efl,
        "file_object_distance_mm": None if math.isinf(source.object_distance_mm) else source.object_distance_mm,
        "scale": scale,
        "focus": settings.focus or ("file" if same_object and same_size else "network"),
        **({"assumptions": list(source.remarks)} if source.remarks else {}),
    }


def read(settings: ImportedLens) -> tuple[Prescription, Mapping[str, Any]]:
    """Read the prescription from the file of an imported lens, and its specification, if any; raises FileError."""
    if settings.file.suffix.lower() == ".zmx":
        return zemax.read(settings.file, settings.catalogues), {}
    source, content = prescription.read(settings.file)
    spec = content.get("spec")
    return source, spec if isinstance(spec, Mapping) else {}


def size(lens: Lens, spec: Mapping[str, Any], reference_um: float) -> tuple[float, float]:
    """Return the focal length [mm] and the F-number of a lens: those of its specification, or else its own.

    A designed lens may differ from its specification by the tolerance of the focal length.
    """
    first_order = paraxial(lens, reference_um)
    efl, f_number = float(first_order.efl), float(first_order.f_number)
    return float(spec.get("efl_mm", efl)), float(spec.get("f_number", f_number))


def _check_light(lens: Lens, view: View, f_number: float, name: str) -> None:
    """Check that no ray of the axial beam, which fills the stop, and no chief ray is lost; raises FileError."""
    beam = axial_beam(lens, view)
    if not beam.valid.all():
        where = describe_loss(beam, ~beam.valid)
        raise FileError(f"{name}: not fast enough for F/{f_number:g}: a marginal ray on the axis is lost {where}")
    chief = chief_rays(lens, view)
    if not chief.valid.all():
        field = int((~chief.valid).flatten().nonzero()[0])
        angle = math.degrees(math.atan(float(view.radii[field]) / view.efl))
        where = describe_loss(chief, ~chief.valid)
        raise FileError(f"{name}: does not cover the field: at {angle:.1f} degrees the chief ray is lost {where}")
