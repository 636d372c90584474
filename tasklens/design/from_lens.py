"""Design from a lens of the user: what is free changes, its glasses and everything else stay."""

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError

from tasklens.design import methods
from tasklens.design.constraints import BUFFER, buffer_scale, first_order_margins, manufacturing_margins
from tasklens.design.merit import Merit
from tasklens.design.ray_space import MARGINAL_RAYS
from tasklens.design.supervisors import OF_STUDY, Designs, Supervisors, supervisors
from tasklens.design.variables import ORDERS
from tasklens.materials.material import AIR
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.spots import chief_rays
from tasklens.optics.io.lens_files import LensFile
from tasklens.optics.lens import Lens
from tasklens.optics.view import View, view_of_spec
from tasklens.runtime.errors import InputError
from tasklens.study import single
from tasklens.study.layers import laid_over
from tasklens.study.messages import problems
from tasklens.study.settings import Constraints, Spec
from tasklens.study.tables import lens_design

_LENGTHS = (  # limits that are lengths
    "min_centre_thickness",
    "max_centre_thickness",
    "min_edge_thickness",
    "min_air_gap",
    "min_back_focus",
    "max_track",
)
_SPOT = {
    "descents": [
        {
            "steps": 500,
            "step_size": 0.3,
            "momentum": 0.95,
            "final": 0.02,
            "criterion": "spot",
            "centre": "chief_ray",
        }
    ]
}


def design(
    file: LensFile,
    method: str,
    free: Mapping[str, Sequence[int] | None] | None,
    settings: Mapping[str, Any],
    constraints: Mapping[str, Any],
    images: Mapping[str, Any] | None,
    classifier: Mapping[str, Any] | None,
    seed: int,
    own: Supervisors = OF_STUDY,
    baselines: Sequence[str] = (),
) -> Designs:
    """Improve a lens by a method.

    Args:
        file: the lens, with its view.
        method: one of `single.methods`, by descents.
        free: variables by name and the surfaces on which they are free, as of `resolved`.
        settings: settings of the method that differ.
        constraints: limits that differ from those of a study, and are kept; the others give way to the lens.
        images, classifier: sections of a study file.
        seed: seed of all random numbers.
        own: images, network and task of a user.
        baselines: criteria that each improve the lens with the same effort, for a comparison.

    Returns:
        The lenses from the start to that of the method.

    Raises:
        InputError: an object at a finite distance, wavelengths that are not three, a variable that the lens does not
            have, or what `tasklens.design` raises.
    """
    spec, view = _spec(file)
    free = resolved(file.lens, free)
    if method == "spot":  # whose own descent begins with flat plates
        settings = laid_over(_SPOT, settings)
    pixels = {"kernel_size": spec.kernel_size, "pixel_pitch_um": spec.pixel_pitch_um}
    changed = {**settings, "free": {name: list(each) for name, each in free.items()}, "keep_apertures": True}
    study = single.study(
        method,
        ("COC",),
        pixels,
        changed,
        {},
        (),
        images,
        classifier,
        alone=True,
        baselines=baselines,
        network_given=own.network is not None,
    )
    limits, remarks = own_limits(file.lens, view, Constraints.model_validate(constraints), set(constraints))
    plastics = tuple(dict.fromkeys(file.lens.media))
    made, notes = {"start": file.lens}, dict[str, Any]()
    with tempfile.TemporaryDirectory() as folder:
        by = supervisors(study, Path(folder), own)
        for name in study.lenses:
            wanted = lens_design(study, name, seed)
            entry = wanted.entry.model_copy(update={"plastics": plastics})
            wanted = wanted.model_copy(update={"entry": entry, "spec": spec, "constraints": limits})
            made[entry.design_name], notes, _ = methods.design(
                wanted,
                by.network if entry.classified else None,
                by.images if entry.supervised else None,
                {"start": (file.lens, 0.0)},
                {},
                task=by.task if entry.classified else None,
            )
    return Designs(made, view, notes, by, (*file.remarks, *remarks))


def resolved(lens: Lens, free: Mapping[str, Sequence[int] | None] | None) -> dict[str, tuple[int, ...]]:
    """Return free variables with their surfaces.

    Args:
        lens: the lens.
        free: surfaces by variable; None in place of surfaces: all that bend light, of distances all but the thickness
            of plane plates. None in place of all: curvatures, distances, and the coefficients of aspheres.

    Raises:
        InputError: an unknown variable, or none.
    """
    refracting = lens.refracting_surfaces
    bent = tuple(i for i in refracting if lens.curvature[i] or lens.alpha[i].any())
    moving = tuple(i for i in refracting if i in bent or i + 1 in bent or lens.media[i] == AIR)
    usual = {"curvature": bent, "thickness": moving, **{f"alpha_{order}": bent for order in ORDERS}}
    if free is None:
        aspheres = tuple(i for i in bent if lens.alpha[i].any() or lens.conic[i])
        return usual | {f"alpha_{order}": aspheres for order in ORDERS}
    if unknown := [name for name in free if name not in usual]:
        raise InputError(f"free: unknown variable {unknown[0]!r}; expected some of {', '.join(usual)}")
    chosen = {name: usual[name] if surfaces is None else tuple(surfaces) for name, surfaces in free.items()}
    if not any(chosen.values()):
        raise InputError("free: expected at least one variable of one surface")
    return chosen


def own_limits(lens: Lens, view: View, limits: Constraints, kept: set[str]) -> tuple[Constraints, list[str]]:
    """Return limits that suit a lens: scaled to its size, and its own values where it breaks them.

    Lengths are those of a phone lens times the ratio of the focal lengths, if the lens is larger.

    Args:
        kept: limits that stay as they are.

    Returns:
        The limits, and a remark on those that are the lens' own.
    """
    scale = max(1.0, view.efl / Spec().efl_mm)
    lengths = {name: scale * getattr(limits, name) for name in _LENGTHS if name not in kept}
    limits = limits.model_copy(update=lengths)
    merit = Merit(view, limits, rim=MARGINAL_RAYS)
    margins = manufacturing_margins(lens, limits, merit.clear_semi_diameters(lens))
    along = first_order_margins(lens, limits, merit.view, chief_rays(lens, merit.view))
    at_view = first_order_margins(lens, limits, view, chief_rays(lens, view))
    margins |= {name: torch.cat([margin, along[name]]) for name, margin in at_view.items()}
    own: dict[str, float] = {}
    for name, margin in margins.items():
        missing = BUFFER * buffer_scale(name) - float(margin.min()) if margin.numel() else 0.0
        if missing > 0 and name not in kept and name in Constraints.model_fields:
            own[name] = getattr(limits, name) + (-missing if name.startswith("min_") else missing)
    changes = ", ".join(f"{name} {value:.4g}" for name, value in own.items())
    remarks = [f"the lens breaks usual limits, which become its own: {changes} (--limit)"] if own else []
    return limits.model_copy(update=own), remarks


def _spec(file: LensFile) -> tuple[Spec, View]:
    """Return the specification of a lens, and its view with nine fields."""
    if file.view.object_vergence:
        raise InputError("designs are for objects at infinity: give --object inf, which refocuses the lens")
    colours = file.view.wavelengths
    if len(colours) != 3 or sorted(colours, reverse=True) != list(colours):
        colours = tuple(sorted(set(colours), reverse=True))
        if len(colours) < 3:
            raise InputError("designs need three wavelengths: --wavelengths 0.65,0.55,0.47")
        colours = colours[0], file.view.reference, colours[-1]
    first_order = paraxial(file.lens, file.view.reference)
    efl = float(first_order.efl)
    tangent = float(file.view.radii.max()) / file.view.efl
    values = {
        "diagonal_mm": 2 * efl * tangent,
        "field_of_view_deg": 2 * math.degrees(math.atan(tangent)),
        "f_number": float(efl / (2 * first_order.entrance_pupil_radius)),
        "pixel_pitch_um": file.view.pixel_pitch,
        "kernel_size": file.view.kernel_size,
        "wavelengths_um": colours,
    }
    if not tangent:
        raise InputError("the lens has no field but the axis: give its field of view in degrees, --field-of-view")
    try:
        spec = Spec.model_validate(values)
    except ValidationError as error:
        raise InputError("; ".join(problems(error, Spec))) from None
    return spec, replace(view_of_spec(spec), efl=spec.efl_mm)
