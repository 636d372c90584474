"""Design from a lens of the user: only the free variables change; glasses and all other values stay."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from tasklens.design.chain import Designs
from tasklens.design.constraints import BUFFER, buffer_scale, limit_margins
from tasklens.design.merit import limit_semi_diameters
from tasklens.design.variables import ORDERS, free_surfaces
from tasklens.optics.analysis.paraxial import check_focal_length, paraxial
from tasklens.optics.analysis.spots import has_light
from tasklens.optics.io import lens_files, prescription
from tasklens.optics.io.lens_specs import LensFile, with_specification
from tasklens.optics.io.prescription import Prescription, with_system_data
from tasklens.optics.io.spec_section import spec_of
from tasklens.optics.lens import Lens
from tasklens.optics.view import View, view_of_spec
from tasklens.runtime.errors import InputError
from tasklens.settings.layers import merged_settings
from tasklens.settings.lens_settings import method_settings
from tasklens.settings.messages import validate
from tasklens.settings.specification import Constraints, Spec

_F_NUMBER = 1e-2  # relative change of the F-number that is mentioned
_WIDEST = 150  # degrees, as in `Spec`
_SIDES = 100  # largest number of the ratio of width and height, as 16:9
_TOUCHING = 1e-6  # mm; surfaces in contact do not cross
_LENGTHS = (  # limits that are lengths
    *("min_centre_thickness", "max_centre_thickness", "min_edge_thickness"),
    *("min_air_gap", "min_back_focus", "max_track"),
)
_SPOT = {"descents": [{"steps": 500, "step_size": 0.3, "momentum": 0.95, "criterion": "spot"}]}


def improvement(
    file: LensFile,
    method: str,
    settings: Mapping[str, Any],
    free: Mapping[str, Sequence[int] | None] | None,
    constraints: Mapping[str, Any],
    remark: Callable[[str], None],
) -> tuple[dict[str, Any], Spec, Constraints, View]:
    """Return the keys of a design that improves a lens, the specification and limits of the lens, and its nine fields.

    Args:
        method: one of `methods` that designs by descents.
        settings: keys of the design that differ from the method's.
        free: free variables by name, with their surfaces, as for `free_surfaces`.
        constraints: limits that differ from those of a study. They are enforced; the others are relaxed to the lens.
        remark: callback for each assumption about the lens, as text.

    Raises:
        InputError: the object is at a finite distance, there are not three wavelengths, the field is too wide, no
            light arrives at a field, surfaces cross, the lens lacks a variable, or a key is wrong.
    """
    given = _constraints(method, settings, constraints)
    for text in file.remarks:
        remark(text)
    check_focal_length(file.lens, file.view.reference_um, "designs need")
    spec, view = _spec(file)
    if not (light := has_light(file.lens, view)).all():
        raise InputError(
            f"no light arrives at {int((~light).sum())} of {len(light)} fields; correct the lens, or give a smaller "
            "--field-of-view"
        )
    free = free_surfaces(file.lens, free)
    base = _SPOT if method == "spot" else method_settings(method)  # the descent of `spot` begins with flat plates
    own = {"start": "flat", "free": {name: list(surfaces) for name, surfaces in free.items()}, "keep_apertures": True}
    limits, relaxed = own_limits(file.lens, view, given, set(constraints))
    for text in filter(None, (relaxed, _fixed_coefficients(file.lens, free))):
        remark(text)
    return merged_settings(base, settings) | own, spec, limits, view


def finished(result: Designs, file: LensFile, view: View, changed: set[str], remark: Callable[[str], None]) -> Designs:
    """Return designs that start from the lens of a file with the data of the file.

    Args:
        view: view of the nine fields.
        changed: keywords that replace data of the file.
        remark: callback for a changed F-number, as text.
    """
    lens, source = result.lens, file.prescription
    before, after = (float(paraxial(other, view.reference_um).f_number) for other in (file.lens, lens))
    if not math.isclose(before, after, rel_tol=_F_NUMBER):
        remark(f"F-number {before:.4g} to {after:.4g}: the stop is fixed, the focal length within its limits is not")
    if changed & {"field_of_view_deg", "object_distance_mm"}:
        source = replace(source, fields=None)
    if "wavelengths_um" in changed or len(source.wavelengths_um or ()) == 3:  # then green is the primary one
        source = replace(source, wavelengths_um=None, primary=None)
    data = with_system_data(replace(source, lens=lens, object_distance_mm=math.inf), view)
    if data.aperture is not None and data.wavelengths_um is not None:
        first_order = paraxial(lens, data.wavelengths_um[data.primary or 0])
        kind = data.aperture[0]
        value = first_order.f_number if kind == "f_number" else 2 * first_order.entrance_pupil_radius
        data = replace(data, aperture=(kind, float(value)))
    return replace(result, view=view, prescription=data)


def read_start(start: Any, catalogues: Sequence[Path], spec: Mapping[str, Any]) -> LensFile:
    """Return the lens that a design starts from: a file, or a lens and its view; raises InputError."""
    if isinstance(start, str | Path):
        return lens_files.read(Path(start), catalogues, **spec)
    if not (isinstance(start, tuple) and [type(part) for part in start] == [Lens, View]):
        raise InputError("start: expected the path of a lens file, or a lens and its view, such as `load_lens` returns")
    if "configuration" in spec:
        raise InputError("configuration: only for the file of a zoom lens; a lens in Python has one")
    lens, view = start
    if bad := lens.not_finite:
        raise InputError(f"start: {bad} of the lens is not finite")
    if lens.pose is not None or lens.melt is not None:
        raise InputError("start: designs need a nominal lens; remove `pose` and `melt`")
    section = {"spec": spec_of(view)}
    content = prescription.to_dict(with_system_data(Prescription(lens.detached()), view)) | section
    return with_specification(prescription.from_dict(content, "start"), section, "start", **spec)


def _constraints(method: str, settings: Mapping[str, Any], constraints: Mapping[str, Any]) -> Constraints:
    """Return the limits of a user; raises InputError for one, or for settings, that belong to other starts."""
    if method == "least_squares":
        raise InputError("method: least_squares starts from random lenses; with `start` choose another method")
    for key in ("free", "keep_apertures", "start"):
        if key in settings:
            advice = "give it as `free` (--free)" if key == "free" else "omit it"
            raise InputError(f"{key}: no setting with the lens of `start`; {advice}")
    given = validate(Constraints, constraints, "constraints")
    if unused := {"stop_distance", "flat_track"} & set(constraints):
        raise InputError(f"constraints.{min(unused)}: only for designs from flat plates; the lens has its own")
    return given


def _fixed_coefficients(lens: Lens, free: Mapping[str, Sequence[int]]) -> str:
    """Say which asphere coefficients of higher order than those of designs stay on surfaces whose others vary."""
    free_aspheres = {surface for name, surfaces in free.items() if name.startswith("alpha") for surface in surfaces}
    aspheres = [i for i in lens.refracting_surfaces if i in free_aspheres]
    orders = [2 * k for k in range(ORDERS[-1] // 2 + 1, lens.alpha.shape[1] + 1) if lens.alpha[aspheres, k - 1].any()]
    return f"asphere coefficients of r^{', r^'.join(map(str, orders))} are fixed" if orders else ""


def own_limits(lens: Lens, view: View, limits: Constraints, fixed_names: set[str]) -> tuple[Constraints, str]:
    """Return limits that suit a lens: scaled to its size, and relaxed to its own values if it violates them.

    Lengths are those of a phone lens. For a larger lens they are multiplied by the ratio of the focal lengths.

    Args:
        fixed_names: limits that do not change.

    Returns:
        The limits, and a remark on those that the lens violates; empty if there are none.

    Raises:
        InputError: surfaces of the lens cross within the light.
    """
    scale = max(1.0, view.efl / Spec().efl_mm)
    lengths = {name: scale * getattr(limits, name) for name in _LENGTHS if name not in fixed_names}
    limits = limits.model_copy(update=lengths)
    margins = limit_margins(lens, limits, view, limit_semi_diameters(lens, view))
    own_values: dict[str, float] = {}
    violated = []
    for name, margin in margins.items():
        deficit = BUFFER * buffer_scale(name) - float(margin.min()) if margin.numel() else 0.0
        if deficit > 0 and name not in fixed_names and name in Constraints.model_fields:
            own_values[name] = getattr(limits, name) + (-deficit if name.startswith("min_") else deficit)
            own = getattr(limits, name) + float(margin.min())
            if name.startswith("min_") and own < -_TOUCHING:
                raise InputError(
                    f"{name}: {own:.3g} mm within the light, so surfaces cross; give a larger "
                    "--f-number or a smaller --field-of-view"
                )
            if margin.min() < 0:  # otherwise only the buffer of designs is missing
                unit = "mm" if name in _LENGTHS else ""
                violated.append(f"{name} {getattr(limits, name):.4g} to {own_values[name]:.4g} {unit}".strip())
    remark = f"limits that the lens violates are relaxed: {', '.join(violated)} (--limit)"
    return limits.model_copy(update=own_values), remark if violated else ""


def _spec(file: LensFile) -> tuple[Spec, View]:
    """Return the specification of a lens, and its view with nine fields."""
    if file.view.object_vergence:
        raise InputError("designs need an object at infinity: give --object-distance inf, which refocuses the lens")
    if len(set(file.view.wavelengths_um)) < 3:
        raise InputError("designs need three wavelengths: --wavelengths 0.65,0.55,0.47")
    radius = float(paraxial(file.lens, file.view.reference_um).entrance_pupil_radius)
    efl = file.view.efl  # of the specification, if the file has one
    tangent = float(file.view.radii.max()) / efl
    if (full := 2 * math.degrees(math.atan(tangent))) >= _WIDEST:
        raise InputError(
            f"a field of view of {full:.4g} degrees: designs need less than {_WIDEST}, as their fields are points of "
            "a pinhole camera; give a smaller --field-of-view"
        )
    values = {
        "diagonal_mm": 2 * float(file.view.radii.max()),
        "field_of_view_deg": full,
        "f_number": efl / (2 * radius),
        "pixel_pitch_um": file.view.pixel_pitch_um,
        "kernel_size": file.view.kernel_size,
        "wavelengths_um": file.view.in_colours().wavelengths_um,
    }
    width, height = file.view.fields.abs().amax(0).tolist()
    if width and height:
        values["aspect"] = Fraction(width / height).limit_denominator(_SIDES).as_integer_ratio()
    if not tangent:
        raise InputError(
            "the lens has no field except the axis: give its full field of view in degrees, --field-of-view"
        )
    spec = validate(Spec, values)
    return spec, replace(view_of_spec(spec), efl=spec.efl_mm)
