"""Specification of a lens: that of its file, or one derived from its prescription, with requested changes."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, TypedDict

import torch
from torch import Tensor

from tasklens.optics.analysis.focus import move_image_plane, refocus
from tasklens.optics.analysis.paraxial import check_focal_length, paraxial
from tasklens.optics.analysis.pupil import check_stop
from tasklens.optics.analysis.spots import light_remarks
from tasklens.optics.io.prescribed_fields import field_tangents
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.io.spec_section import check_copies, view_of, with_reference
from tasklens.optics.io.stop import check_speed, stop_radius
from tasklens.optics.lens import Lens
from tasklens.optics.view import View, view_of_spec
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, positive
from tasklens.settings.messages import validate
from tasklens.settings.specification import Spec

COMPUTED = ("figures", "means", "margins", "worst_margin", "local_optimum")  # for the specification of the file
_AFOCAL = 100.0  # mm; focal length of the pinhole camera whose image points are the fields of an afocal lens
_FOCUS_WORDS = {"mtf": "the peak of the MTF", "spot": "the smallest mean RMS spot"}


class Requested(TypedDict, total=False):
    """Values that replace those of the file of a lens, as in `with_specification`."""

    object_distance_mm: float | None
    wavelengths_um: Sequence[float | str] | None
    focus: str | float | None
    field_of_view_deg: float | None
    f_number: float | None
    pixel_pitch_um: float | None
    kernel_size: int | None


@dataclass(frozen=True)
class LensFile:
    """A lens from a file, with the requested changes.

    Attributes:
        prescription: as in the file.
        lens: the lens at the requested F-number, focused as in the file; at the peak of its MTF if another object
            distance is requested.
        view: fields, wavelengths, pixels and object distance.
        content: other content of a YAML file: spec, origin, figures, margins.
        remarks: assumptions and changes, as text.
        fields: (F, 2) image points of the file's own fields [mm]; None if it has a specification, or if another field
            of view is requested.
    """

    prescription: Prescription
    lens: Lens
    view: View
    content: Mapping[str, Any]
    remarks: tuple[str, ...] = ()
    fields: Tensor | None = None

    @property
    def own_view(self) -> View:
        """The view at the fields of the file if it has its own, else at those of the sensor."""
        return self.view if self.fields is None else replace(self.view, fields=self.fields)


def with_specification(
    source: Prescription,
    content: Mapping[str, Any],
    name: str,
    object_distance_mm: float | None = None,
    wavelengths_um: Sequence[float | str] | None = None,
    focus: str | float | None = None,
    field_of_view_deg: float | None = None,
    f_number: float | None = None,
    pixel_pitch_um: float | None = None,
    kernel_size: int | None = None,
) -> LensFile:
    """Return a lens with its specification.

    Without one in `content` it is derived from the prescription: its largest field, the F-number of its stop, its
    wavelengths, and the distance of its object. Pixels, and values that the prescription does not have, are the
    defaults of a study; `remarks` list them.

    Args:
        source: prescription of the lens.
        content: other content of its file.
        name: of the lens in messages; empty for a lens without a file.
        object_distance_mm: distance of the object in front of the first vertex [mm], or infinity; None: as in `source`.
        wavelengths_um: wavelengths that replace those of the lens; the middle one is the reference [um].
        focus: place of the image plane: "file", as it is; "mtf" or "spot", where these are best; or the shift [um] away
            from the lens. None: as it is, but at the peak of the MTF if the object is at another distance.
        field_of_view_deg, f_number, pixel_pitch_um, kernel_size: values of `Spec` that replace those of the lens.

    Raises:
        InputError: an object distance that is not positive.
        FileError: the lens has no field, the object is in the lens, or a change is invalid; without a name, InputError.
    """
    if object_distance_mm is not None:
        check_distance(object_distance_mm)
    if not isinstance(wavelengths_um, Iterable | None):
        raise InputError(f"wavelengths_um: expected a list, got {wavelengths_um!r}")
    colours = () if wavelengths_um is None else tuple(wavelengths_um)
    if wavelengths_um is not None and not colours:
        raise InputError("wavelengths_um: expected at least one, got none")
    try:
        wavelengths = tuple(positive(value, "wavelengths_um") for value in colours)
        requested = {
            "field_of_view_deg": field_of_view_deg,
            "f_number": f_number,
            "pixel_pitch_um": pixel_pitch_um,
            "kernel_size": kernel_size,
        }
        given = {key: value for key, value in requested.items() if value is not None}
        changes = validate(Spec, given).model_dump(include=set(given))
        distance = source.object_distance_mm if object_distance_mm is None else object_distance_mm
        if changes or wavelengths or object_distance_mm is not None or focus is not None:
            content = without_figures(content)
        remarks = [*source.remarks]
        if "spec" in content:
            view, own = view_of(source.lens, content, name), None
            check_copies(source, content["spec"], view, name)
            view = replace(view, wavelengths_um=wavelengths or view.wavelengths_um)
        else:
            content = {}
            view, own, assumptions = _derived_view(source, wavelengths, changes)
            remarks += assumptions
        source.lens.refractive_indices(view.wavelengths_um)
        lens, view = _change(source.lens, replace(view, object_vergence=1 / distance), changes)
        lens, moved = _place_image_plane(lens, view, source.object_distance_mm, focus)
        return LensFile(source, lens, view, content, (*remarks, *moved, *light_remarks(lens, view)), own)
    except InputError as error:
        if isinstance(error, FileError) or not name:
            raise
        raise FileError(f"{name}: {error}") from None


def without_figures(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a lens file without what was computed for its own specification."""
    return {key: value for key, value in content.items() if key not in COMPUTED}


def check_distance(distance: Any) -> None:
    """Raise InputError if an object is not in front of the lens [mm]."""
    if not isinstance(distance, Real):
        raise InputError(f"object_distance_mm: expected a number, got {distance!r}")
    distance = float(distance)
    if not (distance > 0 and 1 / distance < math.inf):
        raise InputError(
            f"object distance {distance:g} (--object-distance, in Python object_distance_mm): expected millimetres in "
            "front of the first vertex, such as 500, or inf"
        )


def _change(lens: Lens, view: View, changes: Mapping[str, Any]) -> tuple[Lens, View]:
    """Return the lens and its view with changed values of `Spec`; the focal length stays; raises InputError."""
    if "field_of_view_deg" in changes:
        fields = view.fields if view.radii.any() else torch.tensor(Spec().fields_mm, dtype=torch.float64)
        corner = view.efl * math.tan(math.radians(changes["field_of_view_deg"]) / 2)
        view = replace(view, fields=fields * (corner / fields.norm(dim=-1).max()))
    view = replace(
        view,
        pixel_pitch_um=changes.get("pixel_pitch_um", view.pixel_pitch_um),
        kernel_size=changes.get("kernel_size", view.kernel_size),
    )
    if "f_number" in changes:
        lens = lens.with_stop_radius(stop_radius(lens, ("f_number", changes["f_number"]), view.reference_um))
    check_stop(lens)
    check_speed(lens, view)
    return lens, view


def _derived_view(
    source: Prescription, wavelengths: tuple[float, ...], changes: Mapping[str, Any]
) -> tuple[View, Tensor | None, list[str]]:
    """Derive the view of a lens without a specification from its prescription.

    Args:
        wavelengths: wavelengths that replace those of the prescription; may be empty.
        changes: values of `Spec` that differ from it.

    Returns:
        The view, `LensFile.fields`, and remarks.

    Raises:
        InputError: the lens has no field, or a medium has no index at the reference wavelength.
    """
    remarks = []
    if not wavelengths and source.wavelengths_um:
        wavelengths = with_reference(source.wavelengths_um, source.primary or 0)
    elif not wavelengths:
        wavelengths = Spec.model_fields["wavelengths_um"].default
        remarks.append(f"no wavelengths in the file: using {', '.join(map(str, wavelengths))} um (--wavelengths)")
    reference = wavelengths[len(wavelengths) // 2]
    first_order = paraxial(source.lens, reference)
    efl = abs(float(first_order.efl))
    if not first_order.is_positive:
        efl = efl if 0 < efl < math.inf else _AFOCAL
        reason = f"focal length {float(first_order.efl):.4g} mm: not positive, so the lens is only shown and traced"
        remarks.append(f"{reason}; its fields are {efl:.4g} mm tan(theta)")
    view = replace(view_of_spec(Spec(**changes)), efl=efl, wavelengths_um=wavelengths)
    own = None
    if "field_of_view_deg" not in changes:
        own = efl * field_tangents(source, efl, float(first_order.entrance_pupil_z), reference)
        corner = own.norm(dim=1).max()
        view = replace(view, fields=view.fields * (corner / view.radii.max()))
        if not corner:
            view = replace(view, fields=torch.zeros(1, 2, dtype=torch.float64))
            remarks.append("the file has no field except the axis (--field-of-view)")
    if not {"pixel_pitch_um", "kernel_size"} <= set(changes):
        pixels = f"{view.pixel_pitch_um} um, and PSF windows of {view.kernel_size} pixels"
        remarks.append(f"no pixels in the file: using {pixels} (--pixel-pitch, --kernel-size)")
    return view, own, remarks


def _place_image_plane(
    lens: Lens, view: View, own_distance: float, focus: str | float | None
) -> tuple[Lens, list[str]]:
    """Place the image plane of a lens as requested by `focus` of `with_specification`, and say so if it moves.

    Args:
        own_distance: distance of the object in the file [mm].

    Raises:
        InputError: another `focus`, or a lens that cannot be focused.
    """
    moved = view.object_vergence != 1 / own_distance
    criterion, by_shift = "mtf" if moved else "file", 0.0
    try:
        if isinstance(focus, str):
            criterion = focus
        elif focus is not None:
            by_shift = float(focus)
        if criterion not in ("file", *_FOCUS_WORDS) or not math.isfinite(by_shift):
            raise ValueError
    except (TypeError, ValueError):
        raise InputError(f"focus {focus} (--focus): expected micrometres, such as -10, or file, mtf or spot") from None
    if criterion == "file":
        return move_image_plane(lens, 1e-3 * by_shift) if by_shift else lens, []
    needs = "another object distance needs" if focus is None else f"--focus {focus} needs"
    check_focal_length(lens, view.reference_um, needs)
    focused = refocus(lens, view, "spot" if criterion == "spot" else "mtf")
    remark = (
        f"image plane {1e3 * float(focused.thickness[-1] - lens.thickness[-1]):+.1f} um, to {_FOCUS_WORDS[criterion]}"
    )
    if moved:
        own = "infinity" if math.isinf(own_distance) else f"{own_distance:g} mm"
        requested = f"{1 / view.object_vergence:g} mm" if view.object_vergence else "infinity"
        remark = f"object at {own} in the file: refocused for {requested}: {remark}"
    return move_image_plane(focused, 1e-3 * by_shift), [remark]
