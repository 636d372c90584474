"""Manufacturability of a lens: limits, surfaces, and sensitivity of spots to moulding errors."""

import math
from collections.abc import Mapping, Sequence

import pandas

from tasklens.optics.analysis.shapes import Shape
from tasklens.optics.analysis.tolerances import RADIUS, THICKNESS
from tasklens.report.publish import right_aligned

ROBUST = 2.0  # largest ratio of the spot with moulding errors to the nominal spot of a robust lens
_SHOWN = 3  # number of most sensitive parts in the page
_UNITS = dict.fromkeys(("max_slope", "efl_tolerance", "distortion"), "") | {"chief_ray_angle": "rad"}


def markdown(
    margins: Mapping[str, float], shapes: Sequence[Shape], nominal_um: float, errors_um: Mapping[str, float]
) -> str:
    """Return the section of a lens' page: a verdict in words, and its tables.

    Args:
        margins: margin of each limit [mm, slopes and fractions without unit], negative where it is violated.
        shapes: shapes of the surfaces.
        nominal_um: nominal refocused RMS spot, root mean square over fields [um].
        errors_um: increase of the spot by each moulding error, to be added as squares [um].
    """
    built_um = math.hypot(nominal_um, *errors_um.values())
    worst = sorted(errors_um, key=lambda part: errors_um[part], reverse=True)[:_SHOWN]
    limits = pandas.DataFrame(
        [(name.replace("_", " "), f"{value:.4f} {_UNITS.get(name, 'mm')}".strip()) for name, value in margins.items()],
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
        columns=["surface", "semi-diameter [mm]", "steepest [deg]", "off its sphere [um]", "inflections"],
    )
    sensitive = ", ".join(f"{part} ({errors_um[part]:.1f} um)" for part in worst)
    tolerances = (
        f"Moulded to +- {100 * RADIUS:g} % in radius and +- {1e3 * THICKNESS:g} um in thickness (precision moulding, "
        "apollooptical.com/manufacturing-tolerances), and as much in air: the RMS spot, root mean square over fields "
        f"and focused, grows from {nominal_um:.1f} to {built_um:.1f} um. Most sensitive: {sensitive}. Tilt and "
        "decentre come on top."
    )
    parts = [
        "## Manufacturability",
        verdict(margins, nominal_um, built_um),
        tolerances,
        right_aligned(limits),
        right_aligned(surfaces),
    ]
    return "\n\n".join(parts) + "\n"


def verdict(margins: Mapping[str, float], nominal_um: float, built_um: float) -> str:
    """Describe the manufacturability in one or two sentences."""
    violated = [f"{name.replace('_', ' ')} by {-value:.3g}" for name, value in margins.items() if not value >= 0]
    if violated:
        return f"Not manufacturable: it violates {', '.join(violated)}."
    growth = built_um / nominal_um
    if growth <= ROBUST:
        return f"Within precision moulding: all limits are kept, and its errors enlarge the spot {growth:.1f} times."
    return (
        f"Needs tighter tolerances than precision moulding states: all limits are kept, but those errors "
        f"enlarge the spot {growth:.1f} times."
    )
