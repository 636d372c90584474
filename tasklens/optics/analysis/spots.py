"""Rays on the image plane: chief rays, spots, encircled energy, ray fans, distortion, apertures, PSFs and lost light.

Lost rays are NaN in a spot diagram and left out of an RMS. Energies are fractions of the light that passes the clear
apertures, as in a PSF (`passing`): vignetted rays are left out, and other lost rays are outside every radius.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.diffraction import diffraction_psf
from tasklens.optics.analysis.pupil import launch_fields, rim, sobol_disc
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.optics.rays import Rays, describe_loss, passing, transmission
from tasklens.optics.tracing.trace import trace, trace_full
from tasklens.optics.view import View

_LIGHT = 64  # rays per field for the test whether any light arrives
_RIM = 64  # number of marginal rays for semi-diameters and for losses on the axis
_NEAR_AXIS = 1e-4  # field angle [rad] of chief rays near the axis
_LIT = 4096  # rays for the illuminated radii of a lens that vignettes
_CENTRE = torch.zeros(1, 2, dtype=torch.float64)  # pupil point of chief rays
OUTLINE = torch.cat([rim(_RIM), _CENTRE])  # (N, 2) pupil points of marginal and chief rays
_RAYS = 4096  # rays per field and colour for an aperture that vignettes


def trace_fields(lens: Lens, view: View, pupil: Tensor) -> Rays:
    """Trace rays (F, W, N) of all fields and wavelengths through the points `pupil` (N, 2) to the image plane."""
    rays = launch_fields(lens, view, pupil)
    return trace(lens, rays, lens.refractive_indices(view.wavelengths_um))


def trace_fields_full(lens: Lens, view: View, pupil: Tensor) -> tuple[Rays, list[Rays]]:
    """Trace rays as `trace_fields` does; return also rays behind every surface, z from its vertex, without graph."""
    rays = launch_fields(lens, view, pupil)
    return trace_full(lens, rays, lens.refractive_indices(view.wavelengths_um))


def chief_rays(lens: Lens, view: View) -> Rays:
    """Trace the chief rays (F, 1, 1), through the centre of the pupil at the middle wavelength, to the image plane."""
    return trace_fields(lens, view.in_reference(), _CENTRE)


def chief_rays_full(lens: Lens, view: View) -> tuple[Rays, Rays, list[Rays]]:
    """Trace rays as `chief_rays` does; return them at launch, on the image plane, and behind every surface."""
    rays = launch_fields(lens, view, _CENTRE, (view.reference_um,))
    return rays, *trace_full(lens, rays, lens.refractive_indices((view.reference_um,)))


def has_light(lens: Lens, view: View) -> Tensor:
    """Return for each field (F,) whether any light of the reference wavelength arrives."""
    return trace_fields(lens, view.in_reference(), sobol_disc(_LIGHT, seed=0)).valid.any(-1).any(-1)


def chief_points(lens: Lens, view: View) -> Tensor:
    """Compute the image points (F, 2) of the chief rays [mm]; for a lost ray its last point.

    Clear apertures are ignored: light may arrive around a chief ray that they stop.
    """
    rays = chief_rays(lens.with_open_apertures(), view)
    return torch.stack([rays.x[:, 0, 0], rays.y[:, 0, 0]], -1)


def trace_with_chief(lens: Lens, view: View, pupil: Tensor) -> tuple[Rays, Tensor]:
    """Return the rays of `trace_fields` and the points (F, 2) of `chief_points`.

    If no surface but the stop has a clear aperture, the chief ray is one more ray of each bundle.
    """
    if not bool(lens.semi_diameter.isinf()[torch.arange(len(lens.media)) != lens.stop].all()):
        return trace_fields(lens, view, pupil), chief_points(lens, view)
    rays = trace_fields(lens, view, torch.cat([pupil, _CENTRE]))
    middle = len(view.wavelengths_um) // 2
    chief = torch.stack([rays.x[:, middle, -1], rays.y[:, middle, -1]], -1)
    return Rays(*(values[..., :-1] for values in vars(rays).values())), chief


def chief_scale(lens: Lens, view: View) -> Tensor:
    """Compute the image height per field h / (f tan(theta)), (), of chief rays near the axis, on the image plane.

    It is one for a lens of the view's focal length that is focused paraxially for infinity.
    """
    height = view.efl * _NEAR_AXIS
    fields = torch.tensor([[0.0, -height], [0.0, height]], dtype=view.fields.dtype)
    low, high = chief_points(lens, replace(view, fields=fields))[:, 1]
    return (high - low) / (2 * height)


def distortion(fields: Tensor, chief: Tensor) -> Tensor:
    """Compute the distortion (F,) h / h0 - 1: a fraction, negative for a barrel, zero on the axis.

    h0 is the distance of the ideal image point `fields` (F, 2) from the axis: for figures the view's fields times
    `chief_scale`, as in OpticStudio and CODE V, for limits of a design those of a pinhole. h is the component of the
    chief ray's point `chief` (F, 2) along it [mm].
    """
    squared = fields.square().sum(-1)
    off_axis = squared > 0
    return torch.where(off_axis, (chief * fields).sum(-1) / torch.where(off_axis, squared, 1.0) - 1, 0.0)


def centroid(rays: Rays) -> Tensor:
    """Compute the polychromatic centroids (F, 2) of the valid rays [mm]; zero if no ray is valid."""
    weight = rays.valid.to(rays.x.dtype)
    total = weight.sum((1, 2)).clamp(min=1)
    return torch.stack([(weight * v).sum((1, 2)) / total for v in (rays.x, rays.y)], -1)


def spot_diagram(rays: Rays, centre: Tensor) -> Tensor:
    """Return the points (x, y) of rays relative to `centre` (F, 2) of their field, (F, W, N, 2) [mm]; NaN if lost."""
    points = torch.stack([rays.x, rays.y], -1) - centre[:, None, None]
    return torch.where(rays.valid[..., None], points, torch.nan)


def distances(rays: Rays, centre: Tensor) -> Tensor:
    """Compute the distances (F, W, N) of rays from `centre` (F, 2) of their field [mm]; infinite for a lost ray."""
    distance = torch.hypot(rays.x - centre[:, 0, None, None], rays.y - centre[:, 1, None, None])
    return torch.where(rays.valid, distance, torch.inf)


def rms_spot_radius(rays: Rays, centre: Tensor) -> Tensor:
    """Compute sqrt(mean(r^2)), (F,), of the valid rays about `centre` (F, 2) [mm]; infinite if no ray is valid.

    Lost rays are left out, so report it together with the valid fraction.
    """
    squared = (rays.x - centre[:, 0, None, None]).square() + (rays.y - centre[:, 1, None, None]).square()
    squared = torch.where(rays.valid, squared, 0.0)
    count = rays.valid.sum((1, 2))
    return torch.where(count > 0, torch.sqrt(squared.sum((1, 2)) / count.clamp(min=1)), torch.inf)


def encircled_energy_radius(rays: Rays, centre: Tensor, fraction: float) -> Tensor:
    """Compute the smallest radius (F,) about `centre` (F, 2) that encircles `fraction` of the light [mm].

    It is infinite if too few rays are valid. The core of a PSF is 50 % about the image point of the chief ray.
    """
    ordered = distances(rays, centre).flatten(1).sort(1).values
    count = torch.ceil(fraction * passing(rays) * (1 - 1e-12)).long()  # 0.1 x 30 is 3.0000000000000004
    return ordered.gather(1, count.clamp(min=1)[:, None] - 1)[:, 0]


def encircled_energy(rays: Rays, centre: Tensor, radii: Tensor) -> Tensor:
    """Compute the fraction (F, R) of the light within `radii` of `centre` (F, 2) [mm].

    Args:
        radii: (R,) for all fields, or (F, R) [mm].
    """
    ordered = distances(rays, centre).flatten(1).sort(1).values
    limits = radii.expand(len(ordered), -1).contiguous()
    return torch.searchsorted(ordered, limits, right=True).double() / passing(rays)[:, None]


def ray_fans(lens: Lens, view: View, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the transverse ray aberrations of fans of `count` rays; decentres and tilts are ignored.

    Returns:
        (N,) pupil coordinates p, -1 to 1. (F, W, N, 2) errors (ex, ey) [mm] of the tangential rays through (0, p),
        along the field, and (F, W, N, 2) of the sagittal rays through (p, 0), across it; each field is rotated onto +y.
        They are relative to the chief ray of the middle wavelength, and NaN for a lost ray.
    """
    lens, turned = replace(lens, pose=None), view.in_meridian()
    pupil = torch.linspace(-1, 1, count, dtype=torch.float64)
    zero = torch.zeros_like(pupil)
    points = torch.cat([torch.stack([zero, pupil], -1), torch.stack([pupil, zero], -1)])
    errors = spot_diagram(trace_fields(lens, turned, points), chief_points(lens, turned))
    return pupil, errors[:, :, :count], errors[:, :, count:]


def clear_semi_diameters(lens: Lens, view: View, pupil: Tensor = OUTLINE) -> Tensor:
    """Compute the largest height (S,) at which rays through `pupil` (N, 2) pass each surface without loss [mm].

    The outline of the pupil is sufficient unless the lens vignettes.
    """
    heights = [
        torch.where(r.lost_at < 0, torch.hypot(r.x, r.y), 0.0).max() for r in trace_fields_full(lens, view, pupil)[1]
    ]
    return torch.stack(heights)


def lit_semi_diameters(lens: Lens, view: View) -> Tensor:
    """Compute the illuminated radii (S,) of a lens [mm], also if all rays through the rim of its stop are lost."""
    return clear_semi_diameters(lens, view, torch.cat([OUTLINE, sobol_disc(_LIT, seed=0)]))


def evaluation_psf(lens: Lens, view: View, rays: int, diffraction: bool = False) -> Tensor:
    """Compute the PSFs (F, W, K, K), centred on the chief rays, from `rays` fixed pupil points or with diffraction.

    They are normalised to the rays that are not vignetted: vignetted light does not count as outside the window.
    """
    traced = trace_fields(lens, view, sobol_disc(rays, seed=0))
    centre = chief_points(lens, view)
    grid = (
        diffraction_psf(lens, view, centre)
        if diffraction
        else psf(traced, centre, view.pixel_pitch_um, view.kernel_size)
    )
    return grid / transmission(traced)[..., None, None]


def smallest_aperture(heights: Tensor, weight: Tensor, axial: Tensor, loss: float) -> Tensor:
    """Compute the smallest clear radius that passes the axial beam, and all but a fraction `loss` of any other beam.

    Args:
        heights: (F, W, N) distances of rays from the axis [mm]; infinite for a lost ray.
        weight: (N,) fractions of the light of a field and colour; their sum is 1.
        axial: distances of the rays of the axial beam from the axis [mm].
        loss: largest fraction of the light of a field that is stopped.
    """
    ordered, order = heights.flatten(1).sort(-1)
    energy = weight.repeat(heights.shape[1])[order].cumsum(-1) / heights.shape[1]
    enough = (energy < 1 - loss).sum(-1, keepdim=True)
    return torch.maximum(ordered.gather(-1, enough).max(), axial.max())


def heights_at(lens: Lens, view: View, pupil: Tensor, surface: int) -> Tensor:
    """Compute the distances (F, W, N) from the axis at which rays pass a surface [mm]; infinite for a lost ray."""
    rays = trace_fields_full(lens.detached(), view, pupil)[1][surface]
    return torch.where(rays.lost_at < 0, torch.hypot(rays.x, rays.y), torch.inf)


def with_vignetting_aperture(lens: Lens, view: View, surface: int, loss: float) -> Lens:
    """Return the lens with the smallest clear aperture of a surface that stops at most `loss` of any field."""
    heights = heights_at(lens, view, torch.cat([sobol_disc(_RAYS, seed=0), OUTLINE]), surface)
    weight = torch.full((_RAYS,), 1 / _RAYS, dtype=heights.dtype)
    semi_diameter = lens.semi_diameter.clone()
    semi_diameter[surface] = smallest_aperture(heights[..., :_RAYS], weight, heights[view.radii.argmin()], loss)
    return replace(lens, semi_diameter=semi_diameter)


def axial_beam(lens: Lens, view: View) -> Rays:
    """Trace the marginal rays (1, 1, N) of the axis at the middle wavelength to the image plane."""
    on_axis = replace(view.in_reference(), fields=torch.zeros_like(view.fields[:1]))
    return trace_fields(lens, on_axis, rim(_RIM))


def light_remarks(lens: Lens, view: View) -> list[str]:
    """Return remarks on marginal rays lost on the axis, and on fields of which the chief ray or no light arrives."""
    view = view.in_reference()
    chief = chief_rays(lens, view)
    light = has_light(lens, view)
    remarks = []
    beam = axial_beam(lens, view)
    if light.all() and not beam.valid.all():
        where = describe_loss(beam, ~beam.valid)
        remarks.append(f"marginal rays on the axis are lost {where}: the F-number is that of the stop alone")
    for arrives, effect in (
        (light, "no light arrives"),
        (chief.valid[:, 0, 0] | ~light, "the chief ray does not arrive"),
    ):
        if not arrives.all():
            angle = math.degrees(math.atan(float(view.radii[~arrives].min()) / view.efl))
            count = f"{int((~arrives).sum())} of {len(light)} fields, from {angle:.1f} degrees on"
            lost = ~chief.valid & ~arrives[:, None, None]
            reason = f": it is lost {describe_loss(chief, lost)}" if lost.any() else ""
            remarks.append(f"{effect} at {count}{reason}")
    return remarks
