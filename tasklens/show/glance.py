"""Lenses at a glance: a few figures for comparing lenses."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas
import torch

from tasklens.materials.material import AIR, short_name
from tasklens.optics.analysis.mtf import perfect_mtf
from tasklens.optics.lens import Lens
from tasklens.show.certificate import UNITS
from tasklens.show.headings import BY_FIELD, GAP

_NEAR = ("object_distance_mm", "magnification", "working_f_number")  # only for an object at a finite distance
_COLUMNS = {  # key of a row: its heading, format
    "lens": ("lens", ""),
    "efl_mm": ("EFL", ".3f"),
    "f_number": ("F/", ".2f"),
    "track_mm": ("track", ".2f"),
    "object_distance_mm": ("object", "g"),
    "field_of_view_deg": ("field", ".1f"),
    "rms_spot_um": ("RMS", ".2f"),
    "rms_spot_worst_um": ("worst", ".2f"),
    "core_radius_um": ("core", ".2f"),
    "radius_80_um": ("80 %", ".2f"),
    "mtf_half_nyquist": ("MTF", ".2f"),
    "energy_in_window": ("light", ".3f"),
    "distortion_worst_percent": ("distort.", ".2f"),
    "relative_illumination_worst": ("illum.", ".2f"),
    "worst_margin": ("margin", ".4f"),
}
_NOTE = """\
Lengths in mm, field of view in degrees, spots in um, distortion in %. Worst RMS, distortion and illumination: of the
worst field. Means over the fields: RMS, radii of 50 % (core) and 80 % of the light about the chief ray, geometric MTF
at half Nyquist, light in the PSF window. Margin: to the nearest limit of the design, in the limit's unit (mm, slope,
fraction, degrees); a violation is negative."""


def fields_by_angle(figures: Mapping) -> list[int]:
    """Return the indices of the fields from the smallest angle to the largest."""
    return sorted(range(len(figures["angle_deg"])), key=lambda field: figures["angle_deg"][field])


def summary(lens: Lens, content: Mapping, figures: Mapping) -> dict[str, Any]:
    """Summarise a lens: materials, first-order data, and figures at the smallest, middle and largest field.

    Args:
        content: content of its file, with origin and worst margin if present.
        figures: its optical figures.
    """
    order = fields_by_angle(figures)
    fields = list(dict.fromkeys((order[0], order[len(order) // 2], order[-1])))
    pieces = [i for i in lens.refracting_surfaces if lens.media[i] != AIR]
    half_nyquist = figures["nyquist_per_mm"] / 2
    data: dict[str, Any] = {
        "materials": [short_name(lens.media[i]) for i in pieces if not is_plate(lens, i)],
        "plates": [short_name(lens.media[i]) for i in pieces if is_plate(lens, i)],
        **{key: figures[key] for key in ("efl_mm", "f_number", "track_mm", "image_distance_mm", "airy_radius_um")},
        "half_nyquist_per_mm": half_nyquist,
        "perfect_mtf_half_nyquist": float(
            perfect_mtf(torch.tensor(half_nyquist), figures["diffraction_cutoff_per_mm"])
        ),
        "fields": {
            key: [figures[key][field] for field in fields] for key, column in BY_FIELD.items() if column.meaning
        },
    }
    data |= {key: figures[key] for key in _NEAR if key in figures}
    return data | {key: content[key] for key in ("worst_margin", "origin") if key in content}


def is_plate(lens: Lens, surface: int) -> bool:
    """Return whether the medium behind a surface is a plane plate, such as a cover glass, and no element."""
    both = slice(surface, surface + 2)
    return not (lens.curvature[both].any() or lens.alpha[both].any())


def text(name: str, data: Mapping) -> str:
    """Format a summary as a few lines for a terminal."""
    materials = data["materials"]
    plates = f"; plane plates {', '.join(data['plates'])}" if data["plates"] else ""
    lines = [
        f"{name}: {len(materials)} element{'s' * (len(materials) != 1)}, {', '.join(materials)}{plates}",
        f"  focal length {data['efl_mm']:.3f} mm, F/{data['f_number']:.2f}, {data['track_mm']:.2f} mm from the "
        f"first surface to the image",
        f"  diffraction: Airy radius {data['airy_radius_um']:.1f} um, MTF of a perfect lens "
        f"{data['perfect_mtf_half_nyquist']:.2f} at half Nyquist, {data['half_nyquist_per_mm']:.0f} cycles/mm",
    ]
    if "object_distance_mm" in data:
        lines.append(
            f"  object {data['object_distance_mm']:g} mm in front of the first surface, magnification "
            f"{data['magnification']:.4g}, paraxial working F/{data['working_f_number']:.2f}"
        )
    for key, values in data["fields"].items():
        column = BY_FIELD[key]
        lines.append(f"  {column.meaning:<37}" + "".join(f"{format(value, column.digits):>9}" for value in values))
    if "worst_margin" in data:
        limit, value = data["worst_margin"]["limit"], data["worst_margin"]["value"]
        unit, limit = UNITS.get(limit, "mm"), limit.replace("_", " ")
        size = f"{abs(value):.4f} {unit}".strip()
        lines.append(f"  VIOLATES its limit of {limit} by {size}" if value < 0 else f"  worst margin: {size} ({limit})")
    if "design" in data.get("origin", {}):
        origin = data["origin"]
        seed = f", seed {origin['seed']}" if "seed" in origin else ""
        lines.append(f"  design: {origin['design']} by {origin['method']}{seed}")
    return "\n".join(lines)


def row(name: str, content: Mapping, figures: Mapping) -> dict[str, Any]:
    """Return the row of a lens in a table of lenses: means and extremes over its fields."""

    def mean(*keys: str) -> float:
        values = [value for key in keys for value in figures[key]]
        return sum(values) / len(values)

    return {
        "lens": name,
        **{key: figures[key] for key in ("efl_mm", "f_number", "track_mm")},
        **{key: figures[key] for key in ("object_distance_mm",) if key in figures},
        "field_of_view_deg": 2 * max(figures["angle_deg"]),
        "rms_spot_um": mean("rms_centroid_um"),
        "rms_spot_worst_um": max(figures["rms_centroid_um"]),
        "core_radius_um": mean("core_radius_um"),
        "radius_80_um": mean("radius_80_um"),
        "mtf_half_nyquist": mean("mtf_tangential_half_nyquist", "mtf_sagittal_half_nyquist"),
        "energy_in_window": mean("energy_in_window"),
        "distortion_worst_percent": max(figures["distortion_percent"], key=_extent),
        "relative_illumination_worst": min(figures["relative_illumination"]),
        "worst_margin": content.get("worst_margin"),
    }


def _extent(value: float) -> float:
    """Return the magnitude of a number; one that is missing, NaN, exceeds all others."""
    return math.inf if math.isnan(value) else abs(value)


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format rows as a table for a terminal, with a note that explains the columns."""
    margins = [row["worst_margin"] and row["worst_margin"]["value"] for row in rows]
    frame = pandas.DataFrame(rows).assign(worst_margin=margins)
    texts = {
        heading: [GAP if pandas.isna(value) else format(value, form) for value in frame[key]]
        for key, (heading, form) in _COLUMNS.items()
        if key in frame
    }
    return f"{pandas.DataFrame(texts).to_string(index=False)}\n\n{_NOTE}"
