"""Point spread functions by inverse bilinear interpolation of rays, Eqs. (5) and (6) of Yang et al. 2024."""

from typing import Any

import torch
from torch import Tensor

from tasklens.optics.rays import Rays
from tasklens.optics.view import View

_LEAST_ENERGY = 0.5  # inside the PSF window, without a remark


def psf(rays: Rays, centre: Tensor, pixel_pitch: float, kernel_size: int) -> Tensor:
    """Compute the PSF of every field and wavelength on a window of pixels.

    PSF(p) = (1 / N) sum_i tri((p_x - x_i) / L) tri((p_y - y_i) / L),  tri(x) = max(0, 1 - |x|)

    Each of the N launched rays distributes its energy 1 / N over its four nearest pixels. Lost rays and rays outside
    the window contribute nothing: sum(PSF) is the energy inside the window, 1 - sum(PSF) the energy elsewhere.

    Args:
        rays: rays on the image plane, (F, W, N).
        centre: (F, 2) centre of the window on the image plane [mm].
        pixel_pitch: L [um].
        kernel_size: K, odd.

    Returns:
        (F, W, K, K) PSFs; rows along y, columns along x.
    """
    fields, channels, count = rays.x.shape
    column = (rays.x - centre[:, 0, None, None]) * (1e3 / pixel_pitch) + kernel_size // 2
    row = (rays.y - centre[:, 1, None, None]) * (1e3 / pixel_pitch) + kernel_size // 2
    # The indices of far rays would not fit an integer, so they are clamped to just outside the window.
    column, row = column.clamp(-2.0, kernel_size + 1.0), row.clamp(-2.0, kernel_size + 1.0)
    column0, row0 = column.detach().floor(), row.detach().floor()
    right, down = column - column0, row - row0
    plane = torch.arange(fields * channels).reshape(fields, channels, 1) * (kernel_size * kernel_size)
    valid = rays.valid
    indices, weights = [], []
    for dr, wr in ((0, 1 - down), (1, down)):
        for dc, wc in ((0, 1 - right), (1, right)):
            r, c = row0.long() + dr, column0.long() + dc
            inside = valid & (r >= 0) & (r < kernel_size) & (c >= 0) & (c < kernel_size)
            indices.append(torch.where(inside, plane + r * kernel_size + c, 0))
            weights.append(torch.where(inside, wr * wc, 0.0))
    energy = torch.zeros(fields * channels * kernel_size * kernel_size, dtype=rays.x.dtype)
    energy = energy.index_add(0, torch.stack(indices).flatten(), torch.stack(weights).flatten())
    return energy.reshape(fields, channels, kernel_size, kernel_size) / count


def energy_inside(grid: Tensor) -> Tensor:
    """Compute the energy (F,) inside the window, the mean over the wavelengths of PSFs (F, W, K, K)."""
    return grid.detach().sum((-2, -1)).mean(1)


def window_remark(inside: Tensor, kernel_size: int, advice: str = "take a larger kernel_size (--kernel-size)") -> str:
    """Return a remark if less than half of the light of a field is inside the PSF window; empty if not.

    Args:
        inside: (F,) energies inside the window, fractions of the light.
        kernel_size: its width [pixels].
        advice: what to do.
    """
    worst = float(inside.min())
    if worst >= _LEAST_ENERGY:
        return ""
    where = f" at the worst of {len(inside)} fields" * (len(inside) > 1)
    return (
        f"the PSF window of {kernel_size} x {kernel_size} pixels holds only {100 * worst:.1f} % of the light{where}, "
        f"and the rest has no shape in captures; focus the lens, or {advice}"
    )


def psf_notes(view: View, grid: Tensor) -> dict[str, Any]:
    """Return the notes for a file of PSFs (F, W, K, K): fields, wavelengths, pixel pitch, energies in the window."""
    near = {"object_distance_mm": view.object_distance} if view.object_vergence else {}
    return near | {
        "fields_mm": view.fields.tolist(),
        "wavelengths_um": view.wavelengths_um,
        "pixel_pitch_um": view.pixel_pitch_um,
        "energy_inside": grid.sum((-2, -1)).tolist(),
    }
