"""What a lens does: its optical figures, field by field."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tasklens.optics.lens import Lens
from tasklens.optics.paraxial import paraxial
from tasklens.optics.psf import psf
from tasklens.optics.pupil import bundles, rim, sobol_disc
from tasklens.optics.rays import Rays, trace

_RIM = 64  # rays around the pupil for relative illumination and semi-diameters


@dataclass(frozen=True)
class View:
    """How a lens is looked at: where the fields are, in which colours, on which pixels.

    Attributes:
        fields: (F, 2) pinhole image points [mm].
        efl: focal length of that pinhole [mm].
        wavelengths: W of them [um]; the middle one is the reference.
        pixel_pitch: [um].
        kernel: side of the PSF window in pixels, odd.
    """

    fields: Tensor
    efl: float
    wavelengths: tuple[float, ...]
    pixel_pitch: float
    kernel: int

    @property
    def tangents(self) -> Tensor:
        """(F, 2) direction tangents of the fields."""
        return self.fields / self.efl


def trace_fields(lens: Lens, view: View, pupil: Tensor, record: list | None = None) -> Rays:
    """Rays (F, W, N) of every field and wavelength of `view` through the points `pupil` (N, 2), on the image plane."""
    rays = bundles(lens, view.tangents, pupil, view.wavelengths)
    return trace(lens, rays, lens.refractive_indices(view.wavelengths), record)


def chief_points(lens: Lens, view: View) -> Tensor:
    """(F, 2) where the chief ray of each field meets the image plane at the middle wavelength [mm]."""
    rays = trace_fields(lens, view, torch.zeros(1, 2, dtype=torch.float64))
    middle = len(view.wavelengths) // 2
    return torch.stack([rays.x[:, middle, 0], rays.y[:, middle, 0]], -1)


def centroid(rays: Rays) -> Tensor:
    """(F, 2) polychromatic centroid of the valid rays of each field [mm]; zero where no ray is valid."""
    weight = rays.valid.to(rays.x.dtype)
    total = weight.sum((1, 2)).clamp(min=1)
    return torch.stack([(weight * v).sum((1, 2)) / total for v in (rays.x, rays.y)], -1)


def distances(rays: Rays, centre: Tensor) -> Tensor:
    """(F, W, N) distance of each ray from the point `centre` (F, 2) of its field [mm]; infinite for a lost ray."""
    distance = torch.hypot(rays.x - centre[:, 0, None, None], rays.y - centre[:, 1, None, None])
    return torch.where(rays.valid, distance, torch.inf)


def rms_spot_radius(rays: Rays, centre: Tensor) -> Tensor:
    """(F,) sqrt(mean(r^2)) of the valid rays about `centre` (F, 2) [mm]; infinite where no ray is valid."""
    squared = torch.where(rays.valid, distances(rays, centre).square(), 0.0)
    count = rays.valid.sum((1, 2))
    return torch.where(count > 0, torch.sqrt(squared.sum((1, 2)) / count.clamp(min=1)), torch.inf)


def encircled_energy_radius(rays: Rays, centre: Tensor, fraction: float) -> Tensor:
    """(F,) radius about `centre` that holds `fraction` of the launched rays [mm]; infinite where too many are lost."""
    ordered = distances(rays, centre).flatten(1).sort(1).values
    return ordered[:, math.ceil(fraction * ordered.shape[1]) - 1]


def relative_illumination(lens: Lens, view: View) -> Tensor:
    """(F,) illuminance of each field over that of the axis, at the middle wavelength; zero for a lost field.

    Illuminance is the area that the bundle covers in the plane of direction cosines (l, m) behind the lens.
    """
    on_axis = torch.zeros(1, 2, dtype=view.fields.dtype)
    middle = (view.wavelengths[len(view.wavelengths) // 2],)
    with_axis = View(torch.cat([on_axis, view.fields]), view.efl, middle, view.pixel_pitch, view.kernel)
    rays = trace_fields(lens, with_axis, rim(_RIM))
    l, m = rays.l[:, 0], rays.m[:, 0]
    area = 0.5 * (l * m.roll(-1, -1) - m * l.roll(-1, -1)).sum(-1).abs()
    area = torch.where(rays.valid[:, 0].all(-1), area, 0.0)
    return torch.where(area[0] > 0, area[1:] / area[0].clamp(min=1e-12), 0.0)


def clear_semi_diameters(lens: Lens, view: View) -> Tensor:
    """(S,) largest height at which a valid ray of any field and wavelength meets each surface [mm]."""
    record: list[Rays] = []
    trace_fields(lens, view, torch.cat([rim(_RIM), torch.zeros(1, 2, dtype=torch.float64)]), record)
    heights = [torch.where(r.lost_at < 0, torch.hypot(r.x, r.y), 0.0).max() for r in record]
    return torch.stack(heights)


def evaluation_psf(lens: Lens, view: View, rays: int) -> Tensor:
    """(F, W, K, K) PSFs centred on the chief rays, from `rays` fixed pupil points."""
    traced = trace_fields(lens, view, sobol_disc(rays, seed=0))
    return psf(traced, chief_points(lens, view), view.pixel_pitch, view.kernel)


def figures(lens: Lens, view: View, rays: int) -> dict:
    """Optical figures of a finished lens, as plain numbers for its file.

    Lengths in mm, spots in um, one entry per field in the lists. Encircled energy is about the polychromatic
    centroid, like the RMS; distortion is that of the chief ray against the pinhole point, zero on the axis.
    """
    lens = lens.detached()
    first_order = paraxial(lens, view.wavelengths[len(view.wavelengths) // 2])
    traced = trace_fields(lens, view, sobol_disc(rays, seed=0))
    middle, chief = centroid(traced), chief_points(lens, view)
    offset = ((traced.x - chief[:, 0, None, None]).abs(), (traced.y - chief[:, 1, None, None]).abs())
    half_window = view.kernel * view.pixel_pitch / 2e3
    inside = traced.valid & (torch.maximum(*offset) < half_window)
    ideal, real = view.fields.norm(dim=-1), chief.norm(dim=-1)
    distortion = torch.where(ideal > 0, (real - ideal) / ideal.clamp(min=1e-12), 0.0)
    return {
        "efl_mm": float(first_order.efl),
        "bfl_mm": float(first_order.bfl),
        "f_number": float(first_order.efl / (2 * first_order.entrance_pupil_radius)),
        "track_mm": float(lens.thickness[lens.stop :].sum()),
        "valid_fraction": traced.valid.double().mean((1, 2)).tolist(),
        "energy_in_window": inside.double().mean((1, 2)).tolist(),
        "rms_centroid_um": (1e3 * rms_spot_radius(traced, middle)).tolist(),
        "rms_chief_ray_um": (1e3 * rms_spot_radius(traced, chief)).tolist(),
        "radius_50_um": (1e3 * encircled_energy_radius(traced, middle, 0.5)).tolist(),
        "radius_80_um": (1e3 * encircled_energy_radius(traced, middle, 0.8)).tolist(),
        "distortion": distortion.tolist(),
        "relative_illumination": relative_illumination(lens, view).tolist(),
    }
