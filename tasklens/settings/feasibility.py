"""Feasibility of lenses and training steps, checked before the first job; no torch here."""

from collections.abc import Mapping

from tasklens.materials.material import Material
from tasklens.runtime.errors import InputError
from tasklens.settings.design_settings import GradientDesignSettings
from tasklens.settings.specification import Constraints, Spec


def check(name: str, where: str, plastics: tuple[Material, ...], spec: Spec, limits: Constraints) -> None:
    """Check the indices of the plastics, the limits, and the space for flat plates.

    Args:
        name: name of the elements.
        where: key of their specification in the study file.

    Raises:
        InputError: one of them is not feasible.
    """
    for material in plastics:
        for wavelength in spec.wavelengths_um:
            if not material.covers(wavelength):
                low, high = material.range_um
                raise InputError(
                    f"{where}.wavelengths_um: {wavelength} um of {name} is outside the {low} to {high} um for which "
                    f"the coefficients of {material.name} are valid"
                )
            try:
                index = material.refractive_index(wavelength)
            except InputError as error:
                raise InputError(f"materials: {error}") from None
            if not 1 < index < 3:
                raise InputError(
                    f"materials: {material.name} of {name} has the index {index:.6g} at {wavelength} um; expected more "
                    "than 1 and less than 3: correct its coefficients"
                )
    if limits.min_centre_thickness >= limits.max_centre_thickness:
        raise InputError(
            f"constraints.min_centre_thickness: {limits.min_centre_thickness} mm must be less than "
            f"max_centre_thickness = {limits.max_centre_thickness} mm"
        )
    if limits.min_edge_thickness >= limits.max_centre_thickness:
        raise InputError(
            f"constraints.min_edge_thickness: {limits.min_edge_thickness} mm must be less than max_centre_thickness = "
            f"{limits.max_centre_thickness} mm, or no element can be convex"
        )
    elements = len(plastics)
    least = limits.stop_distance + limits.min_back_focus
    least += elements * limits.min_centre_thickness + (elements - 1) * limits.min_air_gap
    available = min(limits.max_track, limits.flat_track * spec.efl_mm)
    if least >= available:
        raise InputError(
            f"constraints: a {name} needs at least {least:.2f} mm from stop to image, but max_track = "
            f"{limits.max_track} mm and flat_track = {limits.flat_track} focal lengths allow {available:.2f} mm; a "
            "flat start would have a negative thickness"
        )


def check_window(what: str, kernel_size: int, sizes: Mapping[str, int]) -> None:
    """Check that images are larger than half of the PSF window; raises InputError.

    Args:
        what: first words of the message, before the width of the window.
        kernel_size: width of the PSF window [pixels].
        sizes: sides of images by their keys [pixels].
    """
    for key, size in sizes.items():
        if kernel_size // 2 >= size:
            raise InputError(f"{what} {kernel_size} must be less than {key} = {size}, since borders are reflected")


def check_descents(where: str, design: GradientDesignSettings, kernel_size: int, size: int) -> None:
    """Check the sizes of images and steps in the descents of a design; raises InputError.

    Args:
        where: key of the design.
        kernel_size: width of the PSF window [pixels].
        size: side of the images [pixels].
    """
    for k, descent in enumerate(design.descents):
        if descent.size is not None and not kernel_size // 2 < descent.size <= size:
            raise InputError(
                f"{where}.descents.{k}.size: expected more than half of spec.kernel_size = {kernel_size} and at most "
                f"images.size = {size}, got {descent.size}"
            )
    check_step(f"{where}.batch_size", design.batch_size, size)
    for k, descent in enumerate(design.descents):
        if descent.batch_size is not None:
            check_step(f"{where}.descents.{k}.batch_size", descent.batch_size, size)


def check_step(where: str, images: int, size: int) -> None:
    """Check that the images of a step fit in the memory of a large machine; raises InputError."""
    if (memory := images * 3 * size**2 * 4) > 1e11:  # [B]
        shape = f"{size} x {size} pixels"
        raise InputError(f"{where}: {images} images of {shape} take {memory / 1e9:.0f} GB; expected at most 100 GB")
