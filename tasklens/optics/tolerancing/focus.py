"""Focus of a built lens, as it is assembled: by its MTF, as that of the design.

Decentres tilt the image surface: in one quadrant that would look like a shift, so that all four are looked at.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import passing
from tasklens.optics.view import View

_FREQUENCY = 0.25  # of Nyquist's, at which modules are focused
_RANGE = 0.06  # largest shift of the image plane, over the focal length
_STEPS = 40  # of the scan to each side
_FITTED = 2  # of them to each side of the best, by a parabola
_RAYS = 256  # per field and colour


def peak(lens: Lens, view: View) -> Tensor:
    """Find the shift of the image plane of the largest MTF, the mean over fields and both orientations [mm].

    It is that of a parabola through the planes nearest to the best one, and differentiable in the lens.
    """
    step = _RANGE * view.efl / _STEPS
    values = through_focus(lens, view.in_all_quadrants(), -_STEPS * step, step, 2 * _STEPS + 1)
    best = int(values[_FITTED:-_FITTED].argmax()) + _FITTED
    x = torch.arange(-_FITTED, _FITTED + 1, dtype=torch.float64)
    near = values[best - _FITTED : best + _FITTED + 1]
    _, slope, bend = torch.linalg.pinv(x[:, None] ** torch.arange(3)) @ near
    offset = -0.5 * slope / bend if bend < 0 else torch.zeros_like(bend)
    return (best - _STEPS + offset.clamp(-1, 1)) * step


def through_focus(lens: Lens, view: View, first: float, step: float, count: int) -> Tensor:
    """Compute the MTF at `frequency` in planes one behind the other.

    The phases of a ray grow by the same amount from plane to plane, so that its phasor is multiplied by a constant.

    Args:
        first, step: shift of the first plane from the image plane, and from each to the next [mm].

    Returns:
        (count,) means over fields and both orientations, as of `mtf.geometric_mtf`.
    """
    rays = trace_fields(lens, view, sobol_disc(_RAYS, seed=0))
    ex, ey = view.directions[:, 0, None, None], view.directions[:, 1, None, None]

    def phasor(x: Tensor, y: Tensor) -> Tensor:
        """Return exp(2 pi i f s) of the tangential and the sagittal coordinate s, (2, F, W, N)."""
        phase = 2 * math.pi * frequency(view) * torch.stack([ex * x + ey * y, ex * y - ey * x])
        return torch.polar(torch.ones_like(phase), phase)

    slope_x, slope_y = rays.l / rays.n, rays.m / rays.n
    turn = phasor(step * slope_x, step * slope_y)
    at = torch.where(rays.valid, phasor(rays.x + first * slope_x, rays.y + first * slope_y), 0.0)
    found = []
    for _ in range(count):
        found.append((at.sum((-2, -1)).abs() / passing(rays)).mean())
        at = at * turn
    return torch.stack(found)


def focused(lens: Lens, view: View, nominal_peak: Tensor) -> tuple[Lens, Tensor]:
    """Focus a built lens: its MTF is largest as far from its image plane as that of the design, `nominal_peak` [mm].

    Returns:
        The lens, and the shift of its image plane [mm]; both are differentiable in both lenses.
    """
    shift = peak(lens, view) - nominal_peak
    thickness = lens.thickness.clone()
    thickness[-1] += shift
    return replace(lens, thickness=thickness), shift


def frequency(view: View) -> float:
    """Return the frequency at which lenses are focused [cycles/mm]."""
    return _FREQUENCY * 1e3 / (2 * view.pixel_pitch)
