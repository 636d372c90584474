"""The stop of a lens that is read: its radius from the aperture of the file, and checks of both."""

import math
from pathlib import Path

from tasklens.optics.analysis.object_points import image_scale
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import launch_fields, rim
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError

_FASTEST = 0.5  # F-number; a lens that obeys the sine condition is slower
_ROUNDING = 1e-3  # relative, of a radius in a file
_RIM = 16  # rays per field for the test whether an object is in the lens


def stop_radius(lens: Lens, aperture: tuple[str, float], wavelength: float) -> float:
    """Compute the radius of the stop [mm] whose paraxial entrance pupil has the diameter D of `aperture`.

    The radius is D / (2 r), with r the radius of the entrance pupil of a stop of radius 1. An image-space F-number is
    EFL / D.
    """
    first_order = paraxial(lens.with_stop_radius(1.0), wavelength)
    kind, value = aperture
    diameter = abs(float(first_order.efl)) / value if kind == "f_number" else value
    return float(diameter / (2 * first_order.entrance_pupil_radius.double()))


def check_radius(source: Prescription, path: Path) -> None:
    """Check that the stop of a prescription has the radius that its aperture needs; raises FileError."""
    if source.aperture is None or not source.wavelengths_um:
        return
    reference = source.wavelengths_um[source.primary or 0]
    try:
        efl = float(paraxial(source.lens, reference).efl)
        needed = stop_radius(source.lens, source.aperture, reference)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None
    if not 0 < efl < math.inf:
        return  # reported later
    radius = float(source.lens.semi_diameter[source.lens.stop])
    if not math.isclose(radius, needed, rel_tol=_ROUNDING):
        kind, value = source.aperture
        raise FileError(
            f"{path}: aperture: {kind} = {value:g} needs a stop of {needed:.5g} mm, but its semi_diameter is "
            f"{radius:.5g}; correct one of them"
        )


def check_speed(lens: Lens, view: View) -> None:
    """Raise InputError if a near object is in the lens, or if the beam on the axis is too fast."""
    if view.object_vergence:
        launch_fields(lens, view, rim(_RIM))
    f_number = abs(float(image_scale(lens, view)) * float(paraxial(lens, view.reference_um).f_number))
    if f_number < _FASTEST:
        raise InputError(
            f"F/{f_number:.2g}: faster than F/{_FASTEST}, the limit of a lens that obeys the sine condition, and of "
            "TaskLens; correct the aperture"
        )
