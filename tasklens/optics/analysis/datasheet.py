"""Optical figures of a lens as plain numbers, for its file and its table."""

import torch

from tasklens.optics.analysis.aberrations import field_curvature, seidel_sums
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.mtf import airy_radius, diffraction_cutoff, geometric_mtf
from tasklens.optics.analysis.object_points import image_scale, magnification
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import check_stop, sobol_disc
from tasklens.optics.analysis.spots import (
    centroid,
    chief_points,
    chief_rays,
    chief_scale,
    distortion,
    encircled_energy_radius,
    rms_spot_radius,
    trace_fields,
)
from tasklens.optics.analysis.wavefront import path_differences, rms_wavefront_error
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, passing
from tasklens.optics.view import View


def figures(lens: Lens, view: View, rays: int) -> dict:
    """Compute the optical figures of a lens; each name ends in its unit, a list has one entry per field.

    Rays are traced through `rays` pupil points per field and wavelength; `valid_fraction` of them are valid.
    Energies and MTF are fractions of the rays that pass the clear apertures: `energy_in_window` is inside the window,
    `core_radius_um` and `radius_80_um` encircle 50 and 80 % about the chief ray. RMS radii use the valid rays.
    `rms_wavefront_waves` is the RMS of their optical path differences at the middle wavelength, without piston and
    tilt. `focus_..._um` is the parabasal focus along z from the image plane. The Seidel sums are totals at the edge of
    the pupil and the largest field. A figure that refers to a lost chief ray is NaN.

    An object at a finite distance adds `object_distance_mm`, `magnification` and the paraxial `working_f_number`, and
    Airy radius and cut-off refer to that F-number. Angles are measured at the centre of the entrance pupil.

    Raises:
        InputError: the radius of the stop is not positive and finite, or the lens forms no real image of the object.
    """
    check_stop(lens)
    lens = lens.detached()
    return _of_the_lens(lens, view) | {"rays": rays} | _by_field(lens, view, rays)


def means(lens: Lens, view: View, rays: int) -> dict[str, float]:
    """Compute means over the fields: RMS about the centroid and core radius [um], and energy inside the window."""
    lens = lens.detached()
    by_field = _spots(lens, view, trace_fields(lens, view, sobol_disc(rays, seed=0)))
    names = {
        "rms_spot_um": "rms_centroid_um",
        "core_radius_um": "core_radius_um",
        "energy_in_window": "energy_in_window",
    }
    return {name: float(by_field[figure].mean()) for name, figure in names.items()}


def _of_the_lens(lens: Lens, view: View) -> dict:
    first_order = paraxial(lens, view.reference_um)
    f_number = float(first_order.f_number)
    working = abs(float(image_scale(lens, view))) * f_number
    near = {}
    if view.object_vergence:
        near["object_distance_mm"] = view.object_distance
        near["magnification"] = magnification(lens, view)
        near["working_f_number"] = working
    return near | {
        "efl_mm": float(first_order.efl),
        "bfl_mm": float(first_order.bfl),
        "image_distance_mm": float(lens.thickness[-1]),
        "track_mm": float(lens.thickness.sum()),
        "f_number": f_number,
        "entrance_pupil_z_mm": float(first_order.entrance_pupil_z),
        "entrance_pupil_diameter_mm": float(2 * first_order.entrance_pupil_radius),
        "exit_pupil_z_mm": float(first_order.exit_pupil_z),
        "exit_pupil_diameter_mm": float(2 * first_order.exit_pupil_radius),
        "airy_radius_um": airy_radius(working, view.reference_um),
        "diffraction_cutoff_per_mm": diffraction_cutoff(working, view.reference_um),
        "nyquist_per_mm": _nyquist(view),
        "seidel_um": {name: sum(values) for name, values in seidel_by_surface(lens, view).items()},
    }


def seidel_by_surface(lens: Lens, view: View) -> dict[str, list[float]]:
    """Compute the contributions of the surfaces to the Seidel sums and to the chromatic aberrations [um]."""
    return {name: (1e3 * values.detach()).tolist() for name, values in seidel_sums(lens, view).items()}


def _nyquist(view: View) -> float:
    """Compute the Nyquist frequency of the pixels [cycles/mm]."""
    return 1e3 / (2 * view.pixel_pitch_um)


def _spots(lens: Lens, view: View, traced: Rays) -> dict[str, torch.Tensor]:
    """Compute the figures of the spots of each field (F,) from rays on the image plane."""
    lost = ~chief_rays(lens, view).valid[:, 0, 0]
    chief = chief_points(lens, view)  # where windows are, also if apertures stop the ray
    offset = ((traced.x - chief[:, 0, None, None]).abs(), (traced.y - chief[:, 1, None, None]).abs())
    inside = traced.valid & (torch.maximum(*offset) < view.kernel_size * view.pixel_pitch_um / 2e3)
    about_chief = {
        "rms_chief_ray_um": 1e3 * rms_spot_radius(traced, chief),
        "core_radius_um": 1e3 * encircled_energy_radius(traced, chief, 0.5),
        "radius_80_um": 1e3 * encircled_energy_radius(traced, chief, 0.8),
        "distortion_percent": 100 * distortion(view.fields * chief_scale(lens, view), chief),
    }
    return {
        "valid_fraction": traced.valid.double().mean((1, 2)),
        "energy_in_window": inside.sum((1, 2)).double() / passing(traced),
        "rms_centroid_um": 1e3 * rms_spot_radius(traced, centroid(traced)),
    } | {name: torch.where(lost, torch.nan, values) for name, values in about_chief.items()}


def _by_field(lens: Lens, view: View, rays: int) -> dict:
    pupil = sobol_disc(rays, seed=0)
    traced = trace_fields(lens, view, pupil)
    spots = _spots(lens, view, traced)
    quarter_and_half = (_nyquist(view) / 4, _nyquist(view) / 2)
    mtf_tangential, mtf_sagittal = geometric_mtf(traced, view.directions, quarter_and_half)
    focus_tangential, focus_sagittal = field_curvature(lens, view)
    columns = {
        "angle_deg": torch.rad2deg(torch.atan(view.radii / view.efl)),
        **{name: spots[name] for name in ("valid_fraction", "energy_in_window", "rms_centroid_um", "rms_chief_ray_um")},
        "rms_wavefront_waves": rms_wavefront_error(path_differences(lens, view.in_reference(), pupil)[:, 0], pupil),
        **{name: spots[name] for name in ("core_radius_um", "radius_80_um")},
        "mtf_tangential_quarter_nyquist": mtf_tangential[:, 0],
        "mtf_sagittal_quarter_nyquist": mtf_sagittal[:, 0],
        "mtf_tangential_half_nyquist": mtf_tangential[:, 1],
        "mtf_sagittal_half_nyquist": mtf_sagittal[:, 1],
        "distortion_percent": spots["distortion_percent"],
        "focus_tangential_um": 1e3 * focus_tangential,
        "focus_sagittal_um": 1e3 * focus_sagittal,
        "relative_illumination": relative_illumination(lens, view),
    }
    return {name: values.tolist() for name, values in columns.items()}
