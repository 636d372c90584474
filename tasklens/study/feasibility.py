"""Feasibility of the lenses of a specification, checked before the first job; no torch here."""

from tasklens.materials.material import Material
from tasklens.study.settings import Constraints, Spec


def check(name: str, where: str, plastics: tuple[Material, ...], spec: Spec, limits: Constraints, size: int) -> None:
    """Check the wavelengths of the plastics, the size of the PSF window, and the room for flat plates.

    Args:
        name: name of the elements.
        where: key of their specification in the study file.
        size: side of the images [pixels].

    Raises:
        ValueError: one of them is not feasible.
    """
    for material in plastics:
        for wavelength in spec.wavelengths_um:
            if not material.covers(wavelength):
                low, high = material.range_um
                raise ValueError(
                    f"{where}.wavelengths_um: {wavelength} um of {name} is outside the {low} to {high} um in which the "
                    f"coefficients of {material.name} hold"
                )
    if spec.kernel_size // 2 >= size:
        raise ValueError(
            f"{where}.kernel_size: half of {spec.kernel_size} must be less than images.size = {size}, since borders "
            "are reflected"
        )
    if limits.min_centre_thickness >= limits.max_centre_thickness:
        raise ValueError(
            f"constraints.min_centre_thickness: {limits.min_centre_thickness} mm must be less than "
            f"max_centre_thickness = {limits.max_centre_thickness} mm"
        )
    elements = len(plastics)
    least = limits.stop_distance + limits.min_back_focus
    least += elements * limits.min_centre_thickness + (elements - 1) * limits.min_air_gap
    available = min(limits.max_track, limits.flat_track * spec.efl_mm)
    if least >= available:
        raise ValueError(
            f"constraints: a {name} takes at least {least:.2f} mm from stop to image, more than the "
            f"{available:.2f} mm of max_track = {limits.max_track} and of {limits.flat_track} focal lengths; a flat "
            "start would have a negative thickness"
        )
