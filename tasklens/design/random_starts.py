"""Random paraxial lenses, from which least squares starts.

Of quadruplets one lens in 800 has room for its focus, so that lenses are drawn by blocks, and most are refused by
arithmetic on the whole block.
"""

from dataclasses import replace

import numpy
import torch
from numpy import ndarray

from tasklens.materials.material import AIR
from tasklens.optics.analysis.paraxial import paraxial, paraxial_ray
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.study.settings import Constraints

_BLOCK = 20_000  # lenses drawn at once
_SPACES = 0.35  # largest element and air thickness [focal lengths]
_ROUNDING = 1e-9  # relative leeway of the refusal by blocks


def random_starts(flat: Lens, view: View, limits: Constraints, count: int, rng: numpy.random.Generator) -> list[Lens]:
    """Return random paraxial lenses, focused, within the track; the last curvature is solved for the focal length.

    Raises:
        InputError: no lens of a block is possible.
    """
    surfaces = list(flat.refracting_surfaces)
    strongest = 0.9 * limits.max_slope / float(flat.semi_diameter[flat.stop])  # slope at the height of the stop
    thinnest = [limits.min_centre_thickness if flat.media[i] != AIR else 2 * limits.min_air_gap for i in surfaces[:-1]]
    low = numpy.array([-strongest] * len(surfaces) + thinnest)
    high = numpy.array([strongest] * len(surfaces) + [_SPACES * view.efl] * len(thinnest))
    found: list[Lens] = []
    while True:
        before, known = rng.bit_generator.state, len(found)
        drawn = low + (high - low) * rng.random((_BLOCK, len(low)))
        for k in numpy.flatnonzero(_possible(drawn, flat, view, limits, strongest)):
            lens = _focused(drawn[k], flat, view, limits, strongest)
            if lens is not None:
                found.append(lens)
            if len(found) == count:
                rng.bit_generator.state = before
                rng.random((k + 1, len(low)))  # what is drawn next does not depend on the size of a block
                return found
        if len(found) == known:
            raise InputError(
                f"none of {_BLOCK} random lenses of focal length {view.efl:.2f} mm has room for its focus within "
                f"constraints.max_track = {limits.max_track:g} mm and no surface steeper than 0.9 of "
                f"constraints.max_slope = {limits.max_slope:g} at the stop; raise one of these, or spec.f_number"
            )


def _possible(drawn: ndarray, flat: Lens, view: View, limits: Constraints, strongest: float) -> ndarray:
    """Return which of the drawn lenses (T, N) have a last curvature, back focus and track within the limits.

    The last curvature gives the focal length to a paraxial ray of height 1.
    """
    surfaces, columns = list(flat.refracting_surfaces), torch.from_numpy(drawn.T)
    indices = flat.refractive_indices((view.reference,))[:, 0, None]
    thickness = flat.thickness[:, None].repeat(1, len(drawn))
    thickness[surfaces[:-1]] = columns[len(surfaces) :]
    curvature = torch.zeros_like(thickness)
    curvature[surfaces[:-1]] = columns[: len(surfaces) - 1]
    steps, one = indices[1:] - indices[:-1], torch.ones(len(drawn), dtype=flat.dtype)
    heights, angles = paraxial_ray(steps * curvature, thickness / indices[1:], one, 0 * one)
    last = (1 / view.efl + angles[-1]) / (heights[-1] * steps[-1])
    back_focus = heights[-1] * view.efl
    track = thickness[:-1].sum(0) + back_focus
    return (
        (last.abs() <= strongest * (1 + _ROUNDING))
        & (back_focus > limits.min_back_focus * (1 - _ROUNDING))
        & (track < limits.max_track * (1 + _ROUNDING))
    ).numpy()


def _focused(drawn: ndarray, flat: Lens, view: View, limits: Constraints, strongest: float) -> Lens | None:
    """Return the lens of drawn curvatures and thicknesses (N,), focused; None beyond the limits."""
    surfaces = list(flat.refracting_surfaces)
    curvature, thickness = flat.curvature.clone(), flat.thickness.clone()
    curvature[surfaces] = torch.from_numpy(drawn[: len(surfaces)])
    curvature[surfaces[-1]] = 0
    thickness[surfaces[:-1]] = torch.from_numpy(drawn[len(surfaces) :])
    lens = replace(flat, curvature=curvature, thickness=thickness)
    without = paraxial(lens, view.reference).power
    unit = torch.zeros_like(curvature)
    unit[surfaces[-1]] = 1
    per_curvature = paraxial(replace(lens, curvature=curvature + unit), view.reference).power - without
    curvature = curvature + unit * (1 / view.efl - without) / per_curvature
    bfl = paraxial(replace(lens, curvature=curvature), view.reference).bfl
    thickness = torch.cat([thickness[:-1], bfl[None]])
    if curvature[surfaces[-1]].abs() > strongest or bfl <= limits.min_back_focus or thickness.sum() >= limits.max_track:
        return None
    return replace(lens, curvature=curvature, thickness=thickness)
