"""Manufacturability of a lens: limits, surfaces, and sensitivity of its rays to manufacturing errors."""

import math
from collections.abc import Mapping, Sequence

import pandas

from tasklens.optics.analysis.shapes import Shape
from tasklens.optics.tolerancing.errors import DEVIATION
from tasklens.show.publish import right_aligned

_SHOWN = 3  # number of most sensitive parts on the page
UNITS = dict.fromkeys(("max_slope", "efl_tolerance", "distortion"), "") | {"chief_ray_angle": "deg"}


def markdown(
    margins: Mapping[str, float],
    shapes: Sequence[Shape],
    errors_um: Mapping[str, float],
    grade: str,
    pixel_um: float,
) -> str:
    """Return the section of a lens' page: a verdict in words, and its tables.

    Args:
        margins: margin of each limit [mm; degrees; slopes and fractions without unit], negative if it is violated.
        shapes: shapes of the surfaces.
        errors_um: displacement of the core's rays by each error, at the size of its tolerance [um].
        grade: name of the tolerance grade.
        pixel_um: pixel pitch [um].
    """
    words = grade.replace("_", " ")
    moved_um = DEVIATION * math.hypot(*errors_um.values())
    worst = sorted(errors_um, key=lambda part: errors_um[part], reverse=True)[:_SHOWN]
    limits = pandas.DataFrame(
        [(name.replace("_", " "), f"{value:.4f} {UNITS.get(name, 'mm')}".strip()) for name, value in margins.items()],
        columns=["limit", "margin"],
    )
    surfaces = pandas.DataFrame(
        [
            (
                shape.surface,
                f"{shape.semi_diameter_mm:.3f}",
                f"{shape.steepest_deg:.1f}",
                f"{shape.departure_um:.1f}",
                shape.inflections,
            )
            for shape in shapes
        ],
        columns=["surface", "semi-diameter [mm]", "steepest [deg]", "departure from sphere [um]", "inflections"],
    )
    sensitive = ", ".join(f"{part} ({errors_um[part]:.1f} um)" for part in worst)
    tolerances = (
        f"Core rays are the half of each field's rays nearest to the chief ray. Errors of {words} in radii, form, "
        f"thickness, index, decentre and tilt move them by {moved_um:.1f} um (RMS over many lenses, after refocusing). "
        f"Largest displacements by one error at its full tolerance: {sensitive}."
    )
    parts = [
        "## Manufacturability",
        verdict(margins, moved_um, words, pixel_um),
        tolerances,
        right_aligned(limits),
        right_aligned(surfaces),
    ]
    return "\n\n".join(parts) + "\n"


def verdict(margins: Mapping[str, float], moved_um: float, grade: str, pixel_um: float) -> str:
    """Describe the manufacturability in a sentence; errors may move the core's rays by up to a pixel."""
    violations = [f"{name.replace('_', ' ')} by {-value:.3g}" for name, value in margins.items() if not value >= 0]
    if violations:
        return f"Not manufacturable: it violates {', '.join(violations)}."
    displacement = f"errors move the core rays by {moved_um:.1f} um RMS; a pixel is {pixel_um:.1f} um."
    if moved_um <= pixel_um:
        return f"Within {grade}. All limits are kept, and its {displacement}"
    return f"Needs tighter tolerances than {grade}. All limits are kept, but its {displacement}"
