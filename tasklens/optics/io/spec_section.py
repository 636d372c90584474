"""The section `spec` of our lens files: fields, wavelengths, pixels and object distance."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from tasklens.optics.analysis.pupil import check_stop
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, number, positive

_SAME = 1e-3  # relative difference of equal values, of which one may be rounded


def view_of(lens: Lens, content: Mapping[str, Any], name: str) -> View:
    """Return the view described by the `spec` of a lens file.

    Raises:
        FileError: the spec is absent or invalid, the stop has no radius, or a medium has no index at a wavelength;
            `name` begins the message.
    """
    spec = content.get("spec")
    if not isinstance(spec, dict):
        raise FileError(f"{name}: has no spec (fields_mm, efl_mm, wavelengths_um, pixel_pitch_um, kernel_size)")
    near = spec.get("object_distance_mm")
    try:
        view = View(
            torch.tensor(_fields(spec["fields_mm"]), dtype=torch.float64).reshape(-1, 2),
            positive(spec["efl_mm"], "efl_mm"),
            tuple(positive(value, "wavelengths_um") for value in _list(spec["wavelengths_um"], "wavelengths_um")),
            positive(spec["pixel_pitch_um"], "pixel_pitch_um"),
            _odd(spec["kernel_size"], "kernel_size"),
            1 / positive(near, "object_distance_mm") if near is not None else 0.0,
        )
        lens.refractive_indices(view.wavelengths_um)
    except KeyError as error:
        raise FileError(f"{name}: its spec has no {error.args[0]}") from error
    except InputError as error:
        raise FileError(f"{name}: its spec cannot be used: {error}") from error
    if not len(view.fields) or not view.wavelengths_um:
        raise FileError(f"{name}: its spec has no fields or no wavelengths")
    try:
        check_stop(lens)
    except InputError as error:
        raise FileError(f"{name}: {error}") from error
    return view


def spec_of(view: View) -> dict[str, Any]:
    """Return the `spec` of a lens file for a view; the object distance is in the prescription."""
    return {
        "fields_mm": view.fields.tolist(),
        "efl_mm": view.efl,
        "wavelengths_um": list(view.wavelengths_um),
        "pixel_pitch_um": view.pixel_pitch_um,
        "kernel_size": view.kernel_size,
    }


def with_reference(wavelengths: Sequence[float], primary: int) -> tuple[float, ...]:
    """Sort wavelengths from the longest to the shortest, but with the primary one, the reference, in the middle."""
    others = sorted((w for i, w in enumerate(wavelengths) if i != primary), reverse=True)
    middle = len(wavelengths) // 2
    return (*others[:middle], wavelengths[primary], *others[middle:])


def _fields(value: Any) -> list[list[float]]:
    points = _list(value, "fields_mm")
    if not all(isinstance(point, list) and len(point) == 2 for point in points):
        raise InputError(f"fields_mm: expected a list of [x, y], found {value!r}; correct it")
    return [[number(v, "fields_mm") for v in point] for point in points]


def _list(value: Any, key: str) -> list:
    if not isinstance(value, list):
        raise InputError(f"{key}: expected a list, found {value!r}; correct it")
    return value


def _odd(value: Any, key: str) -> int:
    size = number(value, key)
    if not (size >= 3 and size % 2 == 1):
        raise InputError(f"{key}: expected an odd number of pixels, at least 3, found {value!r}; correct it")
    return int(size)


def check_copies(source: Prescription, spec: Mapping[str, Any], view: View, name: str) -> None:
    """Raise FileError if a value of the spec contradicts the lens, or values of the spec that count instead of it."""
    corner = float(view.radii.max())
    counting = {
        "diagonal_mm": (2 * corner, "fields_mm"),
        "field_of_view_deg": (2 * math.degrees(math.atan(corner / view.efl)), "fields_mm and efl_mm"),
        "object_distance_mm": (source.object_distance_mm, "object_distance_mm"),
    }
    if "stop_radius_mm" in spec:
        stop = positive(spec["stop_radius_mm"], "stop_radius_mm")
        counting["f_number"] = (view.efl / (2 * stop), "stop_radius_mm")
    for key, (value, others) in counting.items():
        if spec.get(key) is not None and not math.isclose(number(spec[key], key), value, rel_tol=_SAME):
            raise FileError(
                f"{name}: spec.{key} = {spec[key]} contradicts {others}, from which it is {value:.4g}; restore it, and "
                "give other values as options, such as --field-of-view or --f-number, or as keywords"
            )
    if source.wavelengths_um is not None:
        own = with_reference(source.wavelengths_um, source.primary or 0)
        colours = view.wavelengths_um
        same = (sorted(own), own[len(own) // 2]) == (sorted(colours), view.reference_um)
        if not same and (len(own) <= 3 or replace(view, wavelengths_um=own).in_colours().wavelengths_um != colours):
            raise FileError(
                f"{name}: wavelengths_um and primary contradict spec.wavelengths_um, whose middle one is the "
                "reference; correct one of them"
            )
