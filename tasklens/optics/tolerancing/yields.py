"""Spots and contrast of built lenses, and the tolerances with which most of them are good."""

from typing import Any

import torch

from tasklens.optics.analysis import focus
from tasklens.optics.analysis.mtf import geometric_mtf
from tasklens.optics.analysis.paraxial import check_focal_length
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, lit_semi_diameters, rms_spot_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.tolerancing import monte_carlo
from tasklens.optics.tolerancing.manufacturing_errors import draw, errors
from tasklens.optics.tolerancing.monte_carlo import MonteCarlo
from tasklens.optics.tolerancing.sensitivity import displacements
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.runtime.progress import Progress
from tasklens.settings.tolerance_settings import Grade

KEPT_MTF = 0.8  # fraction of the design's MTF that a good lens keeps
_RAYS = 512  # per field and colour
_RIM = 1.02  # clear aperture of a surface without one, divided by the illuminated radius


def tolerances(lens: Lens, view: View, grade: Grade, count: int, seed: int) -> dict[str, Any]:
    """Simulate lenses with the errors of a grade: focus them, and measure spots and MTF in all quadrants of the image.

    Args:
        lens: the design.
        view: fields, wavelengths and pixels.
        grade: largest errors.
        count: number of lenses.
        seed: seed of their errors.

    Returns:
        `design`, the qualities of the lens as designed, and `built`, a row of them per built lens: mean and worst RMS
        spot radius of the fields, `rms_spot_um` and `rms_spot_worst_um` [um], and their mean MTF at `focus.frequency`,
        `mtf_quarter_nyquist`. `errors`: `error_rows`, with the widest tolerances with which a fraction
        `monte_carlo.YIELD` of the lenses keeps `KEPT_MTF` of the design's MTF. `peak_um`: distance of the peak of the
        MTF from the image plane [um], for the design and the built lenses.

    Raises:
        InputError: no light arrives at some field of the design, or its focal length is not positive.
    """
    check_focal_length(lens, view.reference_um, "tolerances need")
    lens = lens.detached().with_clear_apertures(_RIM * lit_semi_diameters(lens, view))
    error_list = errors(lens, grade)
    moved_um = displacements(lens, view, error_list, _RAYS)
    if not moved_um.isfinite().all():
        raise InputError("no light arrives at some field of the lens: give a smaller --field-of-view")
    lenses, progress = MonteCarlo(lens, view, error_list), Progress("built lenses", count)
    qualities = []
    for k, fractions in enumerate(draw(error_list, count, seed), 1):
        qualities.append(_quality(lenses.build(fractions)[0], view))
        progress(k, rms_um=qualities[-1]["rms_spot_um"])
    design = _quality(lens, view)
    draws = draw(error_list, min(count, monte_carlo.TRIED), seed + monte_carlo.SEED)

    def is_good(built_lens: Lens) -> bool:
        return _quality(built_lens, view)["mtf_quarter_nyquist"] >= KEPT_MTF * design["mtf_quarter_nyquist"]

    allotted = monte_carlo.widest(
        monte_carlo.both_axes(error_list, moved_um), lambda scale: lenses.enough_are_good(draws, scale, is_good)
    )
    return {
        "design": design,
        "built": qualities,
        "errors": monte_carlo.error_rows(error_list, allotted, moved_um=moved_um.tolist()),
        "peak_um": 1e3 * float(lenses.peak),
    }


def _quality(lens: Lens, view: View) -> dict[str, float]:
    view = view.in_all_quadrants()
    rays = trace_fields(lens, view, sobol_disc(_RAYS, seed=0))
    radii = 1e3 * rms_spot_radius(rays, centroid(rays))
    mtf = torch.stack(geometric_mtf(rays, view.directions, [focus.frequency(view)]))
    return {
        "rms_spot_um": float(radii.mean()),
        "rms_spot_worst_um": float(radii.max()),
        "mtf_quarter_nyquist": float(mtf.mean()),
    }
