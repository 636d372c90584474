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
from tasklens.optics.analysis.spots import chief_points
from tasklens.optics.io import prescription, zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.view import View, view_of_spec
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.study.messages import problems
from tasklens.study.settings import Spec

_RAYS = 1024  # per field and colour, for the focus
_ROUNDS = 8  # of the search for a field by its image height; each divides the error by the distortion


@dataclass(frozen=True)
class LensFile:
    """A lens from a file, as it is used.

    Attributes:
        prescription: as in the file.
        lens: the lens at the F-number that is asked for, and in focus as in the file; one in focus for a near object
            that has no `spec` is so for infinity, unless an object distance is asked for.
        view: fields, wavelengths and pixels.
        content: what a YAML file says besides: spec, origin, figures, margins.
        remarks: what was assumed or changed, in words.
    """

    prescription: Prescription
    lens: Lens
    view: View
    content: Mapping[str, Any]
    remarks: tuple[str, ...] = ()


def read(
    path: Path, catalogues: Sequence[Path] = (), object_distance_mm: float | None = None, **wanted: Any
) -> LensFile:
    """Read a lens with its specification.

    The specification is that in a lens.yaml of ours. For any other lens it is made from the file: the field up to its
    largest one, the F-number of its stop, its shortest, primary and longest wavelength. Pixels, and what the file does
    not have, are the defaults of a study, which `remarks` say. A lens that is in focus for a near object is refocused
    for infinity, unless `object_distance_mm` is given.

    Args:
        path: a lens.yaml or a .zmx file.
        catalogues: glass catalogues (.agf, or our YAML) of a .zmx file.
        object_distance_mm: distance of the object in front of the first vertex [mm]; None: it is at infinity.
        wanted: keys of `Spec` that differ from the file: field_of_view_deg, f_number, pixel_pitch_um, kernel_size,
            wavelengths_um.

    Raises:
        InputError: an object distance that is not positive and finite.
        FileError: a file that is no lens, or that says nothing of its field where none is wanted; or an object in it.
    """
    vergence = _vergence(object_distance_mm)
    found, content = read_prescription(path, catalogues)
    wanted = {key: value for key, value in wanted.items() if value is not None}
    try:
        used = _used(path, found, content, wanted, vergence)
        view = replace(used.view, object_vergence=vergence)
        if vergence:
            check_object(used.lens, view)
        return replace(used, view=view)
    except ValidationError as error:
        raise FileError(f"{path}: {'; '.join(problems(error, Spec))}") from None
    except FileError:
        raise
    except InputError as error:
        raise FileError(f"{path}: {error}") from None


def _vergence(distance: float | None) -> float:
    if distance is None:
        return 0.0
    if not (0 < distance < math.inf and 1 / distance < math.inf):
        raise InputError(
            f"object distance {distance:g} (--object, in Python object_distance_mm): expected millimetres in front of "
            "the first vertex, such as 500"
        )
    return 1 / distance


def _used(path: Path, found: Prescription, content: dict, wanted: dict, vergence: float) -> LensFile:
    """Return a lens with its specification, for an object at infinity but in focus as for one of this vergence."""
    chosen = Spec.model_validate(wanted)
    wanted = {key: getattr(chosen, key) for key in wanted}
    if "spec" not in content:
        check_stop(found.lens)
        return _derived(found, content, wanted, vergence)
    lens, view = found.lens, view_of(found.lens, content, str(path))
    if wanted:
        given = {key: value for key, value in content["spec"].items() if key in Spec.model_fields}
        lens, view = _changed(lens, content["spec"]["efl_mm"], given, wanted)
    near = math.isfinite(found.object_distance_mm) and not vergence
    remark = f"object at {found.object_distance_mm:g} mm in the file: taken to infinity, without new focus (--object)"
    return LensFile(found, lens, view, content, (remark,) if near else ())


def read_prescription(path: Path, catalogues: Sequence[Path] = ()) -> tuple[Prescription, dict]:
    """Read the prescription of a lens from either kind of file, and what a YAML file says besides; raises FileError."""
    suffix = path.suffix.lower()
    if suffix == ".zmx":
        return zemax.read(path, catalogues), {}
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


def _changed(lens: Lens, efl: float, given: dict, wanted: dict) -> tuple[Lens, View]:
    """Return the lens and its view with the wanted values in place of the given ones; the focal length stays."""
    values = given | wanted
    if "field_of_view_deg" in wanted:
        values["diagonal_mm"] = 2 * efl * math.tan(math.radians(min(wanted["field_of_view_deg"], 149.0)) / 2)
    spec = Spec.model_validate(values)
    view = view_of_spec(spec)
    lens.refractive_indices(view.wavelengths)
    if "f_number" in wanted:
        radius = zemax.stop_radius(lens, ("f_number", spec.f_number), view.reference)
        at_stop = torch.arange(len(lens.media)) == lens.stop
        lens = replace(lens, semi_diameter=torch.where(at_stop, radius, lens.semi_diameter))
    return lens, view


def _derived(found: Prescription, content: Mapping, wanted: dict, vergence: float) -> LensFile:
    """Make the specification of a lens whose file has none from what the file says; raises InputError."""
    remarks = []
    colours = found.wavelengths_um or ()
    middle = colours[found.primary or 0] if colours else 0.0
    given: dict[str, Any] = {}
    if colours and max(colours) > middle > min(colours):
        given["wavelengths_um"] = (max(colours), middle, min(colours))
    elif "wavelengths_um" not in wanted:
        default = Spec.model_fields["wavelengths_um"].default
        taken = ", ".join(map(str, default))
        remarks.append(f"no three wavelengths in the file: taken as {taken} um (--wavelengths)")
    reference = (given | wanted).get("wavelengths_um", Spec.model_fields["wavelengths_um"].default)[1]
    first_order = paraxial(found.lens, reference)
    efl = float(first_order.efl)
    if not 0 < efl < math.inf:
        raise InputError(f"a lens with a focal length of {efl:.4g} mm forms no image")
    given["f_number"] = efl / float(2 * first_order.entrance_pupil_radius)
    if "field_of_view_deg" not in wanted:
        tangent = _largest_tangent(found, efl, float(first_order.entrance_pupil_z), reference, vergence)
        given["field_of_view_deg"] = math.degrees(2 * math.atan(tangent))
        given["diagonal_mm"] = 2 * efl * tangent
    lens, view = _changed(found.lens, efl, given, wanted)
    if not {"pixel_pitch_um", "kernel_size"} <= set(wanted):
        taken = f"{view.pixel_pitch} um, and PSF windows of {view.kernel_size} of them"
        remarks.append(f"no pixels in the file: taken as {taken} (--pixel-pitch, --kernel-size)")
    if math.isfinite(found.object_distance_mm) and not vergence:
        focused = refocused(lens, view, _RAYS)
        shift = 1e3 * float(focused.thickness[-1] - lens.thickness[-1])
        remarks.append(f"object at {found.object_distance_mm:g} mm: refocused for infinity, by {shift:.1f} um")
        lens = focused
    return LensFile(found, lens, view, content, tuple(remarks))


def _largest_tangent(found: Prescription, efl: float, pupil_z: float, wavelength: float, vergence: float) -> float:
    """Compute the tangent of the largest field angle of a prescription.

    Of an object height it is that of the chief ray, h / (distance to the entrance pupil); of a real image height that
    of the chief ray that arrives there.

    Raises:
        InputError: the prescription has no fields but the axis, or such as need a near object.
    """
    kind, points = found.fields or ("", ())
    near = math.isfinite(found.object_distance_mm)
    ask = "give the full field of view in degrees: --field-of-view, in Python field_of_view_deg"
    if kind == "angle_deg":
        largest = max(math.hypot(*(math.tan(math.radians(angle)) for angle in point)) for point in points)
    else:
        largest = max((math.hypot(*point) for point in points), default=0.0)
        if kind == "object_height_mm" and near:
            largest /= found.object_distance_mm + pupil_z
        elif kind == "real_image_height_mm":
            largest = _tangent_of_image_height(found.lens, efl, largest, wavelength, vergence)
        elif kind == "paraxial_image_height_mm" and not near:
            largest /= efl
        elif kind:
            raise InputError(f"fields by {kind.replace('_', ' ')} and this object distance have no angle; {ask}")
    if not 0 < largest < math.inf:
        raise InputError(f"has no field but the axis; {ask}" if kind else f"has neither a spec nor fields; {ask}")
    return largest


def _tangent_of_image_height(lens: Lens, efl: float, height: float, wavelength: float, vergence: float) -> float:
    """Compute the tangent of the field whose chief ray meets the image plane at `height` [mm], by its distortion."""
    tangent = height / efl
    for _ in range(_ROUNDS):
        field = torch.tensor([[0.0, tangent * efl]], dtype=torch.float64)
        view = View(field, efl, (wavelength,), 1.0, 3, vergence)
        found = abs(float(chief_points(lens, view)[0, 1]))
        tangent *= height / found if found > 0 else math.nan
    return tangent
