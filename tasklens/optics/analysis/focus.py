"""The focus of a lens: the peak of its MTF, or the smallest spot.

Decentres tilt the image surface. In one quadrant a tilt looks like a shift, so all four quadrants are evaluated.
"""

import math
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, has_light, rms_spot_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import passing
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError

_FREQUENCY = 0.25  # frequency at which lens modules are focused, as a fraction of Nyquist
_STEP = 0.08  # distance of planes [F-number / frequency]: from one to the next, blurs grow by 0.08 periods
_STEPS = 50  # least number of planes on each side
_RANGE = 0.02  # least shift on each side, as a fraction of the focal length: errors of index and radius scale with it
_INNER = 0.75  # while the peak is farther out than this fraction of the range, the range is doubled
_DOUBLINGS = 4
_FITTED = 2  # planes on each side of the best one that a parabola is fitted to
_RAYS = 256  # per field and colour, for the MTF
_SPOT_RAYS = 1024  # for the spot


def refocus(lens: Lens, view: View, by: Literal["mtf", "spot"] = "mtf") -> Lens:
    """Refocus a lens to the peak of its MTF, or to its smallest spot: the mean over fields of the RMS radius.

    The smallest spot is also where the search for the peak begins. Fields without light are left out.

    Raises:
        InputError: no field has light.
    """
    lit = has_light(lens, view)
    if not lit.any():
        raise InputError("no ray of any field reaches the image; correct the apertures, or the fields")
    view = replace(view, fields=view.fields[lit])
    lens = move_image_plane(lens, _smallest_spot(lens, view))
    return move_image_plane(lens, float(peak(lens.detached(), view))) if by == "mtf" else lens


def move_image_plane(lens: Lens, shift: Tensor | float) -> Lens:
    """Move the image plane of a lens away from it by `shift` [mm]."""
    thickness = lens.thickness.clone()
    thickness[-1] += shift
    return replace(lens, thickness=thickness)


def _smallest_spot(lens: Lens, view: View) -> float:
    """Return the shift of the image plane to the smallest mean over fields of the RMS spot about the centroid [mm].

    Rays are straight behind the lens, so that each RMS is the norm of an affine function of the shift: the mean is
    convex, with one minimum.
    """
    from scipy.optimize import minimize_scalar

    traced = trace_fields(lens.detached(), view, sobol_disc(_SPOT_RAYS, seed=0))

    def mean_rms(shift: float) -> float:
        moved = replace(traced, x=traced.x + shift * traced.l / traced.n, y=traced.y + shift * traced.m / traced.n)
        return float(rms_spot_radius(moved, centroid(moved)).mean())

    return float(minimize_scalar(mean_rms, bracket=(0.0, 0.01 * view.efl)).x)


def peak(lens: Lens, view: View) -> Tensor:
    """Compute the shift of the image plane that maximises the mean MTF over fields and both orientations [mm].

    It is the vertex of a parabola fitted to the planes around the best one, and differentiable in the lens.
    """
    pupil = float(paraxial(lens.detached(), view.reference_um).entrance_pupil_radius)
    # To full stops, so that planes do not move with the lens; of the view, since plates have no focal length.
    f_stop = 2 ** (round(2 * math.log2(view.efl / (2 * pupil))) / 2)
    step = _STEP * f_stop / frequency(view)
    steps = max(_STEPS, math.ceil(_RANGE * view.efl / step))
    for _ in range(_DOUBLINGS + 1):
        values = through_focus(lens, view.in_all_quadrants(), -steps * step, step, 2 * steps + 1)
        best = int(values[_FITTED:-_FITTED].argmax()) + _FITTED
        if abs(best - steps) <= _INNER * steps:
            break
        steps *= 2
    x = torch.arange(-_FITTED, _FITTED + 1, dtype=torch.float64)
    near = values[best - _FITTED : best + _FITTED + 1]
    _, slope, bend = torch.linalg.pinv(x[:, None] ** torch.arange(3)) @ near
    offset = -0.5 * slope / bend if bend < 0 else torch.zeros_like(bend)
    return (best - len(values) // 2 + offset.clamp(-1, 1)) * step


def through_focus(lens: Lens, view: View, first: float, step: float, count: int) -> Tensor:
    """Compute the MTF at `frequency` in equally spaced planes.

    The phase of a ray grows by the same amount from plane to plane, so its phasor is multiplied by a constant.

    Args:
        first, step: shift of the first plane from the image plane, and distance between planes [mm].

    Returns:
        (count,) means over fields and both orientations of the MTF as in `mtf.geometric_mtf`.
    """
    rays = trace_fields(lens, view, sobol_disc(_RAYS, seed=0))
    ex, ey = view.directions[:, 0, None, None], view.directions[:, 1, None, None]

    def phasor(x: Tensor, y: Tensor) -> Tensor:
        """Return exp(2 pi i f s) of the tangential and the sagittal coordinate s, (2, F, W, N)."""
        phase = 2 * math.pi * frequency(view) * torch.stack([ex * x + ey * y, ex * y - ey * x])
        return torch.polar(torch.ones_like(phase), phase)

    slope_x, slope_y = rays.l / rays.n, rays.m / rays.n
    turn = phasor(step * slope_x, step * slope_y)
    phasors = torch.where(rays.valid, phasor(rays.x + first * slope_x, rays.y + first * slope_y), 0.0)
    moduli = []
    for _ in range(count):
        moduli.append((phasors.sum((-2, -1)).abs() / passing(rays)).mean())
        phasors = phasors * turn
    return torch.stack(moduli)


def frequency(view: View) -> float:
    """Return the frequency at which lenses are focused [cycles/mm]."""
    return _FREQUENCY * 1e3 / (2 * view.pixel_pitch_um)
