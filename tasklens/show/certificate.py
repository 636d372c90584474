"""Page of one lens: first-order data, figures by field, aberrations by surface, manufacturability."""

import math
from collections.abc import Mapping, Sequence

import pandas
import torch

from tasklens.optics.aspheres import radial_slope, sag
from tasklens.optics.lens import Lens
from tasklens.optics.tolerancing.manufacturing_errors import DEVIATION
from tasklens.show.headings import BY_FIELD
from tasklens.show.optimality import optimum
from tasklens.show.publish import right_aligned

UNITS = dict.fromkeys(("max_slope", "efl_tolerance", "distortion"), "") | {"chief_ray_angle": "deg"}  # else mm
_SENSITIVE = 3  # number of most sensitive parts on the page
_HEIGHTS = torch.linspace(0, 1, 401, dtype=torch.float64)  # fractions of the semi-diameter
_SEIDEL = {
    "spherical": "S_I",
    "coma": "S_II",
    "astigmatism": "S_III",
    "petzval": "S_IV",
    "distortion": "S_V",
    "axial_colour": "C_I",
    "lateral_colour": "C_II",
}
_NOTE = """\
{rays} rays per field and colour; "valid" is the fraction that arrives. Light in the window, EE50, EE80 and MTF use the
light that passes the clear apertures; EE50 and EE80 are the radii about the chief ray that encircle 50 % and 80 % of
it. The RMS is of the rays that arrive. RMS wavefront: at the middle wavelength, about the best image point (without
piston and tilt). The MTF is geometric, at {quarter:.0f} and {half:.0f} cycles/mm (1/4 and 1/2 of the sensor's Nyquist
frequency); diffraction lowers it further, to zero at {cutoff:.0f} cycles/mm. T is along the field, S across it. Focus:
of rays next to the chief ray, along z from the image plane. Aberrations: Seidel sums of the wavefront at the edge of
the pupil and the largest field, at the middle wavelength; C_I and C_II from the longest to the shortest wavelength.
Distortion, relative to chief rays near the axis, and relative illumination are at the middle wavelength."""


def markdown(title: str, fields_mm: Sequence, content: Mapping, by_surface: Mapping[str, Sequence[float]]) -> str:
    """Return the table of a lens as Markdown.

    Args:
        fields_mm: (X, Y) of each field [mm].
        content: content of the lens file: `figures`, and `margins`, `worst_margin` and `origin` if present.
        by_surface: contributions of the surfaces to each Seidel sum [um], by name.
    """
    figures = content["figures"]
    lens = pandas.DataFrame(_lens(content).items(), columns=["figure", "value"])
    rows = {column.text: [format(value, column.digits) for value in figures[key]] for key, column in BY_FIELD.items()}
    points = {f"{axis} [mm]": [f"{point[i]:.2f}" for point in fields_mm] for i, axis in enumerate("xy")}
    fields = pandas.DataFrame(points | rows).T.rename(columns=lambda field: str(field + 1))
    fields = fields.rename_axis("field").reset_index()
    columns = {_SEIDEL[key]: [*values, figures["seidel_um"][key]] for key, values in by_surface.items()}
    surfaces = pandas.DataFrame(columns).map(lambda value: f"{value:.3f}")
    surfaces.insert(0, "surface", [*map(str, range(len(surfaces) - 1)), "sum"])
    nyquist = figures["nyquist_per_mm"]
    note = _NOTE.format(
        rays=figures["rays"], quarter=nyquist / 4, half=nyquist / 2, cutoff=figures["diffraction_cutoff_per_mm"]
    )
    limits = ["## Limits", right_aligned(_margins(content["margins"]))] if "margins" in content else []
    parts = [
        f"# {title}",
        right_aligned(lens),
        *limits,
        "## Fields",
        right_aligned(fields),
        "## Aberrations [um]",
        right_aligned(surfaces),
        note,
    ]
    return "\n\n".join(parts) + "\n"


def _lens(content: Mapping) -> dict[str, str]:
    figures = content["figures"]
    rows = {
        "focal length [mm]": f"{figures['efl_mm']:.4f}",
        "back focal length [mm]": f"{figures['bfl_mm']:.4f}",
        "image distance [mm]": f"{figures['image_distance_mm']:.4f}",
        "track, first surface to image [mm]": f"{figures['track_mm']:.4f}",
        "F-number": f"{figures['f_number']:.3f}",
        "entrance pupil, from the first surface [mm]": f"{figures['entrance_pupil_z_mm']:.4f}",
        "entrance pupil diameter [mm]": f"{figures['entrance_pupil_diameter_mm']:.4f}",
        "exit pupil, from the last surface [mm]": f"{figures['exit_pupil_z_mm']:.4f}",
        "exit pupil diameter [mm]": f"{figures['exit_pupil_diameter_mm']:.4f}",
        "Airy radius [um]": f"{figures['airy_radius_um']:.2f}",
        "diffraction cut-off [cycles/mm]": f"{figures['diffraction_cutoff_per_mm']:.0f}",
    }
    if "object_distance_mm" in figures:
        rows |= {
            "object, in front of the first surface [mm]": f"{figures['object_distance_mm']:g}",
            "magnification": f"{figures['magnification']:.4g}",
            "paraxial working F-number": f"{figures['working_f_number']:.3f}",
        }
    if "worst_margin" in content:
        rows["worst margin"] = f"{content['worst_margin']['value']:.4f} ({content['worst_margin']['limit']})"
    origin = content.get("origin", {})
    if "assumptions" in origin:
        rows["assumptions about the file"] = "; ".join(origin["assumptions"])
    if "validation_loss" in origin:
        rows["loss of this lens on the fixed images of its design"] = f"{origin['validation_loss']:.4f}"
    if (test := optimum(content)) is not None:
        images = f", on {test.images} images" if test.images else ""
        rows[f"largest decrease of the loss by a small step within the limits{images}"] = str(test)
    losses = origin.get("candidate_losses", {})
    return rows | {f"loss of {name} as a candidate start": f"{loss:.4f}" for name, loss in losses.items()}


def _margins(margins: Mapping[str, float]) -> pandas.DataFrame:
    """Return the margin of each limit; negative if it is violated."""
    rows = [(name.replace("_", " "), f"{value:.4f} {UNITS.get(name, 'mm')}".strip()) for name, value in margins.items()]
    return pandas.DataFrame(rows, columns=["limit", "margin"])


def shapes(lens: Lens) -> pandas.DataFrame:
    """Compute the shape of every refracting surface within its clear aperture, which must be finite.

    Returns:
        A row per surface: `surface`, its index; `semi_diameter_mm`, the radius of the clear aperture; `steepest_deg`,
        the largest angle between the surface and its vertex plane; `departure_um`, the largest distance along z from
        the sphere through vertex and rim; `inflections`, the number of heights at which the second derivative of the
        sag changes its sign.
    """
    return pandas.DataFrame([_shape(lens.detached(), i) for i in lens.refracting_surfaces])


def _shape(lens: Lens, i: int) -> dict[str, float]:
    semi_diameter = float(lens.semi_diameter[i])
    height = semi_diameter * _HEIGHTS
    surface = lens.curvature[i], lens.conic[i], lens.alpha[i]
    z, slope = sag(height**2, *surface)[0], radial_slope(height, *surface)
    rim = z[-1]
    # z^2 - 2 z / c + r^2 = 0 on a sphere; this c is of the sphere through the rim
    curvature = 2 * rim / (rim**2 + semi_diameter**2)
    sphere = sag(height**2, curvature, torch.zeros_like(curvature), lens.alpha[i, :0])[0]
    bending = torch.sign(slope.diff())
    bending = bending[bending != 0]
    return {
        "surface": i,
        "semi_diameter_mm": semi_diameter,
        "steepest_deg": float(torch.rad2deg(torch.atan(slope.abs().max()))),
        "departure_um": 1e3 * float((z - sphere).abs().max()),
        "inflections": int((bending[1:] != bending[:-1]).sum()),
    }


def manufacturability(
    margins: Mapping[str, float],
    surfaces: pandas.DataFrame,
    errors_um: Mapping[str, float],
    grade: str,
    pixel_um: float,
) -> str:
    """Return the section on manufacturability as Markdown: a verdict in words, and its tables.

    Args:
        margins: margin of each limit [mm; degrees; slopes and fractions without unit], negative if it is violated.
        surfaces: their `shapes`.
        errors_um: displacement of the core's rays by each error, at the size of its tolerance [um].
        grade: name of the tolerance grade.
        pixel_um: pixel pitch [um].
    """
    words = grade.replace("_", " ")
    moved_um = DEVIATION * math.hypot(*errors_um.values())
    worst = sorted(errors_um, key=lambda part: errors_um[part], reverse=True)[:_SENSITIVE]
    table = pandas.DataFrame(
        {
            "surface": surfaces["surface"],
            "semi-diameter [mm]": surfaces["semi_diameter_mm"].map("{:.3f}".format),
            "steepest [deg]": surfaces["steepest_deg"].map("{:.1f}".format),
            "departure from sphere [um]": surfaces["departure_um"].map("{:.1f}".format),
            "inflections": surfaces["inflections"],
        }
    )
    sensitive = ", ".join(f"{part} ({errors_um[part]:.1f} um)" for part in worst)
    tolerances = (
        f"Core rays are the half of each field's rays nearest to the chief ray. Errors of {words} in radii, form, "
        f"thickness, index, decentre and tilt move them by {moved_um:.1f} um (RMS over many lenses, after refocusing). "
        f"Largest displacements by one error at its full tolerance: {sensitive}."
    )
    parts = [
        "## Manufacturability",
        limits_verdict(margins, moved_um, words, pixel_um),
        tolerances,
        right_aligned(table),
    ]
    return "\n\n".join(parts) + "\n"


def limits_verdict(margins: Mapping[str, float], moved_um: float, grade: str, pixel_um: float) -> str:
    """Describe the manufacturability in a sentence; errors may move the core's rays by up to a pixel."""
    violations = [f"{name.replace('_', ' ')} by {-value:.3g}" for name, value in margins.items() if not value >= 0]
    if violations:
        return f"Not manufacturable: it violates {', '.join(violations)}."
    displacement = f"errors move the core rays by {moved_um:.1f} um RMS; a pixel is {pixel_um:.1f} um."
    if moved_um <= pixel_um:
        return f"Within {grade}. All limits are kept, and its {displacement}"
    return f"Needs tighter tolerances than {grade}. All limits are kept, but its {displacement}"
