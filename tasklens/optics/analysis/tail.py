"""Energy in the tail of a PSF, and encircled energy.

Distances are measured from the image point of the chief ray, the centre of the cached PSFs. All energies are fractions
of the light that passes the clear apertures.
"""

import torch
from torch import Tensor

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import (
    chief_points,
    distances,
    encircled_energy_radius,
    rms_spot_radius,
    trace_fields,
)
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, passing
from tasklens.optics.view import View

TAIL = 3.0  # radius outside which light belongs to the tail [core radii]
RADII_UM = [round(10 ** (k / 20), 3) for k in range(-20, 61)]  # 20 per decade, 0.1 um to 1 mm


def encircled_energy(rays: Rays, centre: Tensor, radii: Tensor) -> Tensor:
    """Compute the fraction (F, R) of the light within `radii` of `centre` (F, 2) [mm].

    Args:
        radii: (R,) for all fields, or (F, R) [mm].
    """
    ordered = distances(rays, centre).flatten(1).sort(1).values
    limits = radii.expand(len(ordered), -1).contiguous()
    return torch.searchsorted(ordered, limits, right=True).double() / passing(rays)[:, None]


def tail(lens: Lens, view: View, rays: int) -> tuple[list[dict], list[dict]]:
    """Measure the tail and the encircled energy of each field, with `rays` pupil points per field and wavelength.

    Returns:
        A row per field: `core_radius_um` and `radius_80_um` encircle 50 % and 80 % of the light, `tail_energy` is the
        fraction outside 3 core radii (NaN if the core is infinite), `energy_outside_window` the fraction outside the
        square PSF window, `rms_chief_ray_um` the RMS distance of the valid rays.
        Rows (field, radius_um, fraction) of the encircled energy.
    """
    traced, centre = trace_fields(lens, view, sobol_disc(rays, seed=0)), chief_points(lens, view)
    core = encircled_energy_radius(traced, centre, 0.5)
    offset = torch.stack([traced.x, traced.y], -1) - centre[:, None, None]
    inside = traced.valid & (offset.abs().amax(-1) < view.kernel_size * view.pixel_pitch_um / 2e3)
    tail_energy = 1 - encircled_energy(traced, centre, TAIL * core[:, None])[:, 0]
    figures = {
        "core_radius_um": 1e3 * core,
        "radius_80_um": 1e3 * encircled_energy_radius(traced, centre, 0.8),
        "tail_energy": torch.where(core.isfinite(), tail_energy, torch.nan),
        "energy_outside_window": 1 - inside.sum((1, 2)).double() / passing(traced),
        "rms_chief_ray_um": 1e3 * rms_spot_radius(traced, centre),
    }
    columns = {name: values.tolist() for name, values in figures.items()}
    by_field = [
        {"field": field} | {name: values[field] for name, values in columns.items()} for field in range(len(core))
    ]
    curves = encircled_energy(traced, centre, torch.tensor(RADII_UM, dtype=torch.float64) / 1e3).tolist()
    curve = [
        {"field": field, "radius_um": radius, "fraction": fraction}
        for field, fractions in enumerate(curves)
        for radius, fraction in zip(RADII_UM, fractions, strict=True)
    ]
    return by_field, curve
