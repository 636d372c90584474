"""Lens files of both kinds, our YAML and Zemax's .zmx, with the specification that figures need."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError

from tasklens.optics.analysis.datasheet import view_of
from tasklens.optics.analysis.focus import refocused
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import check_object, check_stop
from tasklens.optics.analysis.spots import chief_rays, lit
from tasklens.optics.io import prescription, zemax
from tasklens.optics.io.fields import largest_tangent
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.view import View, view_of_spec
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, positive
from tasklens.study.messages import problems
from tasklens.study.settings import Spec

_RAYS = 1024  # per field and colour, for the focus
_AXIS_DEG = 1.0  # field of view of a specification whose only field is the axis


@dataclass(frozen=True)
class LensFile:
    """A lens from a file, as it is used.

    Attributes:
        prescription: as in the file.
        lens: the lens at the F-number that is asked for, and in focus as in the file; one in focus for a near object is
            refocused if another distance is asked for and it has no `spec`.
        view: fields, wavelengths, pixels and object distance.
        content: what a YAML file says besides: spec, origin, figures, margins.
        remarks: what was assumed or changed, in words.
    """

    prescription: Prescription
    lens: Lens
    view: View
    content: Mapping[str, Any]
    remarks: tuple[str, ...] = ()


def read(
    path: Path,
    catalogues: Sequence[Path] = (),
    object_distance_mm: float | None = None,
    configuration: int | None = None,
    wavelengths_um: Sequence[float | str] | None = None,
    **changes: Any,
) -> LensFile:
    """Read a lens with its specification.

    The specification is that in a lens.yaml of ours. For any other lens it is made from the file: the field up to its
    largest one, the F-number of its stop, its wavelengths, and the distance of its object. Pixels, and what the file
    does not have, are the defaults of a study, which `remarks` say.

    Args:
        path: a lens.yaml or a .zmx file.
        catalogues: glass catalogues (.agf, or our YAML) of a .zmx file.
        object_distance_mm: distance of the object in front of the first vertex [mm], or infinity; None: as in the file.
        configuration: of a .zmx file with several; None: the one in which it was saved.
        wavelengths_um: wavelengths in place of those of the file, the middle one the reference [um].
        changes: keys of `Spec` that differ from the file: field_of_view_deg, f_number, pixel_pitch_um, kernel_size.

    Raises:
        InputError: an object distance that is not positive.
        FileError: a file that is no lens, or that says nothing of its field; or an object in the lens.
    """
    _check_distance(object_distance_mm)
    shown, content = read_prescription(path, catalogues, configuration)
    changes = {key: value for key, value in changes.items() if value is not None}
    try:
        wavelengths = tuple(positive(value, "wavelengths_um") for value in wavelengths_um or ())
        spec = Spec.model_validate(changes)
        changes = {key: getattr(spec, key) for key in changes}
        distance = shown.object_distance_mm if object_distance_mm is None else object_distance_mm
        if "spec" in content:
            used = _specified(shown, content, changes, wavelengths, 1 / distance, str(path))
        else:
            check_stop(shown.lens)
            used = derived(shown, changes, wavelengths, 1 / distance)
        if used.view.object_vergence:
            check_object(used.lens, used.view)
        return replace(used, remarks=(*shown.remarks, *used.remarks, *_dark(used)))
    except ValidationError as error:
        raise FileError(f"{path}: {'; '.join(problems(error, Spec))}") from None
    except FileError:
        raise
    except InputError as error:
        raise FileError(f"{path}: {error}") from None


def _check_distance(distance: float | None) -> None:
    if distance is not None and not (distance > 0 and 1 / distance < math.inf):
        raise InputError(
            f"object distance {distance:g} (--object, in Python object_distance_mm): expected millimetres in front of "
            "the first vertex, such as 500, or inf"
        )


def _specified(
    shown: Prescription, content: dict, changes: dict, wavelengths: tuple[float, ...], vergence: float, name: str
) -> LensFile:
    """Return a lens with the specification of its file, changed."""
    lens, view = shown.lens, view_of(shown.lens, content, name)
    wavelengths = wavelengths or view.wavelengths
    if changes:
        own = {key: value for key, value in content["spec"].items() if key in Spec.model_fields}
        own.pop("wavelengths_um", None)
        lens, view = _changed(lens, content["spec"]["efl_mm"], own, changes, wavelengths)
    view = replace(view, wavelengths=wavelengths, object_vergence=vergence)
    lens.refractive_indices(wavelengths)
    remarks = []
    near = shown.object_distance_mm
    if math.isfinite(near) and vergence != 1 / near:
        remarks.append(f"object at {near:g} mm in the file: taken to {_distance(vergence)}, without new focus")
    return LensFile(shown, lens, view, content, tuple(remarks))


def read_prescription(
    path: Path, catalogues: Sequence[Path] = (), configuration: int | None = None
) -> tuple[Prescription, dict]:
    """Read the prescription of a lens from either kind of file, and what a YAML file says besides; raises FileError."""
    suffix = path.suffix.lower()
    if suffix == ".zmx":
        return zemax.read(path, catalogues, configuration), {}
    if suffix in (".yaml", ".yml"):
        return prescription.read(path)
    raise FileError(f"{path}: expected a lens file, .yaml or .zmx")


def write(path: Path, found: Prescription, notes: Mapping[str, Any]) -> None:
    """Write a lens as YAML with `notes`, or by the suffix .zmx for Zemax, which needs fields and wavelengths.

    Raises:
        FileError: another suffix, or a lens that the format cannot hold.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        own = prescription.to_dict(found)
        prescription.write(path, found, {key: value for key, value in notes.items() if key not in own})
    elif path.suffix.lower() == ".zmx":
        zemax.write(path, found)
    else:
        raise FileError(f"{path}: expected .yaml, or .zmx for Zemax")


def _changed(lens: Lens, efl: float, own: dict, changes: dict, wavelengths: tuple[float, ...]) -> tuple[Lens, View]:
    """Return the lens and its view with changes of its own values; the focal length stays."""
    values = own | changes
    if "field_of_view_deg" in changes:
        values["diagonal_mm"] = 2 * efl * math.tan(math.radians(min(changes["field_of_view_deg"], 149.0)) / 2)
    spec = Spec.model_validate(values)
    view = replace(view_of_spec(spec), wavelengths=wavelengths)
    lens.refractive_indices(wavelengths)
    if "f_number" in changes:
        radius = zemax.stop_radius(lens, ("f_number", spec.f_number), view.reference)
        at_stop = torch.arange(len(lens.media)) == lens.stop
        lens = replace(lens, semi_diameter=torch.where(at_stop, radius, lens.semi_diameter))
    return lens, view


def derived(shown: Prescription, changes: dict, wavelengths: tuple[float, ...], vergence: float) -> LensFile:
    """Make the specification of a lens that has none from its prescription.

    Args:
        shown: the prescription.
        changes: values of `Spec` that differ from it.
        wavelengths: wavelengths in place of those of the prescription, or none.
        vergence: 1 / distance of the object [1/mm].

    Raises:
        InputError: it forms no image, or has no field.
    """
    remarks = []
    if not wavelengths and shown.wavelengths_um:
        wavelengths = _with_reference(shown.wavelengths_um, shown.primary or 0)
    elif not wavelengths:
        wavelengths = Spec.model_fields["wavelengths_um"].default
        remarks.append(f"no wavelengths in the file: taken as {', '.join(map(str, wavelengths))} um (--wavelengths)")
    reference = wavelengths[len(wavelengths) // 2]
    first_order = paraxial(shown.lens, reference)
    efl = float(first_order.efl)
    if not 0 < efl < math.inf:
        raise InputError(f"a lens with a focal length of {efl:.4g} mm forms no image")
    own: dict[str, Any] = {"f_number": efl / float(2 * first_order.entrance_pupil_radius)}
    tangent = 1.0
    if "field_of_view_deg" not in changes:
        tangent = largest_tangent(shown, efl, float(first_order.entrance_pupil_z), reference)
        own["field_of_view_deg"] = math.degrees(2 * math.atan(tangent)) if tangent else _AXIS_DEG
        own["diagonal_mm"] = 2 * efl * math.tan(math.radians(own["field_of_view_deg"]) / 2)
    lens, view = _changed(shown.lens, efl, own, changes, wavelengths)
    if not tangent:
        view = replace(view, fields=torch.zeros(1, 2, dtype=torch.float64))
        remarks.append("no field but the axis in the file (--field-of-view)")
    if not {"pixel_pitch_um", "kernel_size"} <= set(changes):
        pixels = f"{view.pixel_pitch} um, and PSF windows of {view.kernel_size} of them"
        remarks.append(f"no pixels in the file: taken as {pixels} (--pixel-pitch, --kernel-size)")
    view = replace(view, object_vergence=vergence)
    near = shown.object_distance_mm
    if math.isfinite(near) and vergence != 1 / near:
        focused = refocused(lens, view, _RAYS)
        shift = 1e3 * float(focused.thickness[-1] - lens.thickness[-1])
        remarks.append(f"object at {near:g} mm in the file: refocused for {_distance(vergence)}, by {shift:.1f} um")
        lens = focused
    return LensFile(shown, lens, view, {}, tuple(remarks))


def _distance(vergence: float) -> str:
    return f"{1 / vergence:g} mm" if vergence else "infinity"


def _with_reference(wavelengths: Sequence[float], primary: int) -> tuple[float, ...]:
    """Return wavelengths from the longest to the shortest, but with the primary one, the reference, in the middle."""
    others = sorted((w for i, w in enumerate(wavelengths) if i != primary), reverse=True)
    middle = len(wavelengths) // 2
    return (*others[:middle], wavelengths[primary], *others[middle:])


def _dark(used: LensFile) -> list[str]:
    """Return a remark if the chief ray of some fields, or all their light, does not arrive."""
    view = used.view.in_reference()
    chief = chief_rays(used.lens, view).valid[:, 0, 0]
    light = lit(used.lens, view)
    remarks = []
    for arrives, what in ((light, "no light arrives"), (chief | ~light, "the chief ray does not arrive")):
        if not arrives.all():
            angle = math.degrees(math.atan(float(view.radii[~arrives].min()) / view.efl))
            count = int((~arrives).sum())
            remarks.append(
                f"{what} at {count} of {len(light)} fields, from {angle:.1f} degrees on: clear apertures stop it"
            )
    return remarks
