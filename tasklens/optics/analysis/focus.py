"""The best focus of a lens."""

from dataclasses import replace

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, rms_spot_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError


def refocused(lens: Lens, view: View, rays: int) -> Lens:
    """Refocus a lens to the smallest mean over fields of the RMS spot radius about the centroid.

    Rays are straight behind the lens, so that each RMS is the norm of an affine function of the shift: the mean is
    convex, with one minimum. Fields without light are left out.

    Raises:
        InputError: no field has light.
    """
    from scipy.optimize import minimize_scalar

    traced = trace_fields(lens, view, sobol_disc(rays, seed=0))

    lit = traced.valid.flatten(1).any(1)
    if not lit.any():
        raise InputError("no ray of any field reaches the image; correct the apertures, or the fields")

    def mean_rms(shift: float) -> float:
        moved = replace(traced, x=traced.x + shift * traced.l / traced.n, y=traced.y + shift * traced.m / traced.n)
        return float(rms_spot_radius(moved, centroid(moved))[lit].mean())

    thickness = lens.thickness.clone()
    thickness[-1] += minimize_scalar(mean_rms, bracket=(0.0, 0.01 * view.efl)).x
    return replace(lens, thickness=thickness)
