"""Starting lenses of designs: flat plates, and random paraxial lenses for least squares."""

from dataclasses import replace

import numpy
import torch
from numpy import ndarray

from tasklens.design.variables import ORDERS
from tasklens.materials.material import AIR, Material
from tasklens.optics.analysis.paraxial import paraxial, paraxial_ray
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.settings.specification import Constraints, Spec

_BACK = 0.35  # last space [focal lengths], if there is room; small: far from the stop, fields separate on the plates
_AIR = 0.5  # air spaces [plate thicknesses]
_BLOCK = 20_000  # lenses drawn at once
_SPACES = 0.35  # largest element and air thickness [focal lengths]
_ROUNDING = 1e-9  # relative leeway of the rejection by blocks


def flat(plastics: tuple[Material, ...], spec: Spec, constraints: Constraints) -> Lens:
    """Return plane-parallel plates behind a stop, a lens without power."""
    plates = len(plastics) + _AIR * (len(plastics) - 1)  # with the air between them [plate thicknesses]
    room = constraints.flat_track * spec.efl_mm - constraints.stop_distance
    last = min(_BACK * spec.efl_mm, room - plates * constraints.min_centre_thickness)
    back = max(last, constraints.min_back_focus)
    plate = (room - back) / plates
    media, thickness = [AIR], [constraints.stop_distance]
    for plastic in plastics:
        media += [plastic, AIR]
        thickness += [plate, _AIR * plate]
    thickness[-1] = back
    surfaces = len(media)
    zeros = torch.zeros(surfaces, dtype=torch.float64)
    semi_diameter = torch.full_like(zeros, torch.inf)
    semi_diameter[0] = spec.stop_radius_mm
    return Lens(
        curvature=zeros,
        conic=zeros.clone(),
        alpha=torch.zeros(surfaces, ORDERS[-1] // 2, dtype=torch.float64),
        thickness=torch.tensor(thickness, dtype=torch.float64),
        semi_diameter=semi_diameter,
        media=tuple(media),
        stop=0,
    )


def random_starts(plates: Lens, view: View, limits: Constraints, count: int, rng: numpy.random.Generator) -> list[Lens]:
    """Return random paraxial lenses, focused, within the track; the last curvature is solved for the focal length.

    Raises:
        InputError: no lens of a block is within the limits.
    """
    surfaces = list(plates.refracting_surfaces)
    steepest = 0.9 * limits.max_slope / float(plates.semi_diameter[plates.stop])  # slope at the height of the stop
    thinnest = [
        limits.min_centre_thickness if plates.media[i] != AIR else 2 * limits.min_air_gap for i in surfaces[:-1]
    ]
    low = numpy.array([-steepest] * len(surfaces) + thinnest)
    high = numpy.array([steepest] * len(surfaces) + [_SPACES * view.efl] * len(thinnest))
    lenses: list[Lens] = []
    while True:
        state, count_before = rng.bit_generator.state, len(lenses)
        samples = low + (high - low) * rng.random((_BLOCK, len(low)))
        for k in numpy.flatnonzero(_possible(samples, plates, view, limits, steepest)):
            lens = _focus(samples[k], plates, view, limits, steepest)
            if lens is not None:
                lenses.append(lens)
            if len(lenses) == count:
                rng.bit_generator.state = state
                rng.random((k + 1, len(low)))  # the next random numbers do not depend on the size of a block
                return lenses
        if len(lenses) == count_before:
            raise InputError(
                f"none of {_BLOCK} random lenses of focal length {view.efl:.2f} mm focuses within "
                f"constraints.max_track = {limits.max_track:g} mm with surfaces no steeper than 0.9 times "
                f"constraints.max_slope = {limits.max_slope:g} at the stop; raise one of these, or spec.f_number"
            )


def _possible(samples: ndarray, plates: Lens, view: View, limits: Constraints, steepest: float) -> ndarray:
    """Return which of the lenses `samples` (T, N) have a last curvature, back focus and track within the limits.

    The last curvature gives the focal length to a paraxial ray of height 1.
    """
    surfaces, columns = list(plates.refracting_surfaces), torch.from_numpy(samples.T)
    indices = plates.refractive_indices((view.reference_um,))[:, 0, None]
    thickness = plates.thickness[:, None].repeat(1, len(samples))
    thickness[surfaces[:-1]] = columns[len(surfaces) :]
    curvature = torch.zeros_like(thickness)
    curvature[surfaces[:-1]] = columns[: len(surfaces) - 1]
    steps, one = indices[1:] - indices[:-1], torch.ones(len(samples), dtype=plates.dtype)
    heights, angles = paraxial_ray(steps * curvature, thickness / indices[1:], one, 0 * one)
    last = (1 / view.efl + angles[-1]) / (heights[-1] * steps[-1])
    back_focus = heights[-1] * view.efl
    track = thickness[:-1].sum(0) + back_focus
    return (
        (last.abs() <= steepest * (1 + _ROUNDING))
        & (back_focus > limits.min_back_focus * (1 - _ROUNDING))
        & (track < limits.max_track * (1 + _ROUNDING))
    ).numpy()


def _focus(sample: ndarray, plates: Lens, view: View, limits: Constraints, steepest: float) -> Lens | None:
    """Return the focused lens of sampled curvatures and thicknesses (N,); None if it is beyond the limits."""
    surfaces = list(plates.refracting_surfaces)
    curvature, thickness = plates.curvature.clone(), plates.thickness.clone()
    curvature[surfaces] = torch.from_numpy(sample[: len(surfaces)])
    curvature[surfaces[-1]] = 0
    thickness[surfaces[:-1]] = torch.from_numpy(sample[len(surfaces) :])
    lens = replace(plates, curvature=curvature, thickness=thickness)
    power = paraxial(lens, view.reference_um).power
    unit = torch.zeros_like(curvature)
    unit[surfaces[-1]] = 1
    per_curvature = paraxial(replace(lens, curvature=curvature + unit), view.reference_um).power - power
    curvature = curvature + unit * (1 / view.efl - power) / per_curvature
    bfl = paraxial(replace(lens, curvature=curvature), view.reference_um).bfl
    thickness = torch.cat([thickness[:-1], bfl[None]])
    if curvature[surfaces[-1]].abs() > steepest or bfl <= limits.min_back_focus or thickness.sum() >= limits.max_track:
        return None
    return replace(lens, curvature=curvature, thickness=thickness)
