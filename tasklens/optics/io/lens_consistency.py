"""Mistakes in an edited lens.yaml: misspelled keys, and values that contradict the copy that counts."""

import math
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from tasklens.optics.io import prescription
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.view import View
from tasklens.runtime.files import FileError, number, positive
from tasklens.settings.messages import suggestion
from tasklens.settings.specification import Spec

COMPUTED = (
    "figures",
    "means",
    "margins",
    "worst_margin",
    "local_optimum",
)  # keys of a lens file for its own specification
_KEYS = (*prescription.KEYS, "spec", "origin", "digest", *COMPUTED)
_SPEC = (*Spec.model_fields, *Spec.model_computed_fields)
_SIMILAR = 0.8  # of a misspelled key
_SAME = 1e-3  # relative difference of equal values, of which one may be rounded


def check_keys(content: Mapping[str, Any], path: Path) -> None:
    """Raise FileError for a key that is nearly one of a lens file, or unknown in its spec; other keys are notes."""
    for key in content:
        if key not in _KEYS and get_close_matches(str(key), _KEYS, 1, _SIMILAR):
            raise FileError(f"{path}: {key}: unknown key{suggestion(str(key), dict.fromkeys(_KEYS))}")
    spec = content.get("spec")
    for key in spec if isinstance(spec, Mapping) else ():
        if key not in _SPEC:
            raise FileError(f"{path}: spec.{key}: unknown key{suggestion(str(key), dict.fromkeys(_SPEC))}")


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
        primary = source.wavelengths_um[source.primary or 0]
        if (sorted(source.wavelengths_um), primary) != (sorted(view.wavelengths_um), view.reference_um):
            raise FileError(
                f"{name}: wavelengths_um and primary contradict spec.wavelengths_um, whose middle one is the "
                "reference; correct one of them"
            )
