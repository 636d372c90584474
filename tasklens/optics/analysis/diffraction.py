"""Point spread functions with diffraction: the field on the image plane as a sum of plane waves along the rays.

U(x, y) = (1 / lambda) sum_i w_i sqrt(pi |J_i|) i^t_i exp(2 pi i (L_i + n' (l_i (x - x_i) + m_i (y - y_i))) / lambda)

Ray i carries the fraction w_i of the energy. L_i is its optical path from the object to its point (x_i, y_i) on the
image plane, n' is the index there, and J_i the determinant of d(n' l, n' m) / d(pupil x, y). This is the integral of
Debye and Wolf over the directions of the rays; each small area of the pupil is a plane wave. Its energy equals that of
the rays, and for short wavelengths it tends to the geometric spot.

A strongly aberrated rim bends the wavefront so far that several rays have the same direction. By the method of
stationary phase each gets a factor i^t, with t the number (0, 1 or 2) of principal curvatures of the wavefront that
diverge.

Source: Born and Wolf, Principles of Optics (1999), section 8.8; Stamnes, Waves in Focal Regions (1986), for both.
"""

import math
from dataclasses import dataclass, replace

import finufft
import torch
from torch import Tensor

from tasklens.optics.analysis.object_points import object_path
from tasklens.optics.analysis.pupil import gauss_quadrature, launch_fields
from tasklens.optics.lens import Lens
from tasklens.optics.tracing.trace import trace
from tasklens.optics.view import View

_LEAST_SAMPLES = 4  # samples of the irradiance per pixel and direction
_SHIFT = 1e-5  # change of a pupil point in the differences for J
_MARGIN = 8.0  # distance from the points beyond which rays are ignored [wavelength / aperture]
_LEAST_RINGS = 24  # least number of rings of pupil points
_ACCURACY = 1e-6  # of the Fourier transform, relative to the sum of the waves
_COARSE = 6  # rings of a first trace that locates the rays


def irradiance(lens: Lens, view: View, field: int, channel: int, x: Tensor, y: Tensor) -> Tensor:
    """Compute the irradiance (Y, X) of a point at one field and wavelength [1/mm^2]; its integral is the energy.

    The sum of plane waves at equally spaced points is a Fourier transform from unequally spaced directions.

    Args:
        x, y: (X,) and (Y,) equally spaced coordinates on the image plane [mm].

    Returns:
        Irradiance for a total energy of 1 of the launched rays; the energy of lost rays is missing.
    """
    wavelength = 1e-3 * view.wavelengths_um[channel]
    coarse = _waves(lens, view, field, channel, _COARSE)
    beyond = _MARGIN * wavelength / coarse.aperture
    coarse = coarse.near(x, y, beyond)
    if not len(coarse.x):  # no light at this field
        return torch.zeros(len(y), len(x), dtype=torch.float64)
    # Rings and arms resolve the phase between any ray and any point.
    reach = 2 * beyond + max(torch.hypot(coarse.x - a, coarse.y - b).max() for a in x[[0, -1]] for b in y[[0, -1]])
    cycles = float(reach) * coarse.aperture / 2 / wavelength  # across the radius of the pupil
    rings = max(_LEAST_RINGS, math.ceil(1.2 * math.pi * cycles))
    waves = _waves(lens, view, field, channel, rings).near(x, y, beyond)
    amplitude = torch.sqrt(math.pi * waves.determinant) * waves.weight / wavelength
    (x0, dx), (y0, dy) = ((v[len(v) // 2], v[1] - v[0] if len(v) > 1 else 0.0) for v in (x, y))
    phase = _angle((waves.l * x0 + waves.m * y0 + waves.length) / wavelength)
    steps = (_angle(waves.m * dy / wavelength), _angle(waves.l * dx / wavelength))
    strength = torch.polar(amplitude, phase).numpy()
    field_there = finufft.nufft2d1(
        *(step.numpy() for step in steps), strength, (len(y), len(x)), isign=1, eps=_ACCURACY, nthreads=1
    )
    return torch.from_numpy(field_there).abs().square()


def diffraction_psf(lens: Lens, view: View, centre: Tensor) -> Tensor:
    """Compute the PSFs (F, W, K, K) of a lens with diffraction; rows along y, columns along x.

    The irradiance is distributed over the nearest pixels, like the rays in `psf`: PSF(p) is its integral times
    tri((p_x - x) / L) tri((p_y - y) / L). The sum is the energy inside the window.

    Args:
        centre: (F, 2) centre of the window on the image plane [mm].
    """
    pitch, size = 1e-3 * view.pixel_pitch_um, view.kernel_size
    grids = []
    for field in range(len(view.fields)):
        for channel, wavelength in enumerate(view.wavelengths_um):
            # The irradiance has no frequencies above aperture / wavelength.
            aperture = _waves(lens, view, field, channel, _COARSE).aperture
            count = max(_LEAST_SAMPLES, math.ceil(1.05 * view.pixel_pitch_um * aperture / wavelength))
            offsets = torch.arange(-count * (size // 2 + 1), count * (size // 2 + 1) + 1, dtype=torch.float64) / count
            tri = (1 - (torch.arange(size)[:, None] - size // 2 - offsets).abs()).clamp(min=0)
            x, y = (pitch * offsets + centre[field, k] for k in (0, 1))
            grids.append(tri @ irradiance(lens, view, field, channel, x, y) @ tri.T * (pitch / count) ** 2)
    return torch.stack(grids).reshape(len(view.fields), -1, size, size)


@dataclass(frozen=True)
class _Waves:
    """Plane waves along N rays, without lost ones.

    Attributes:
        x, y: points of the rays on the image plane [mm].
        l, m: direction cosines times the index.
        length: optical path at x = y = 0 of the image plane, with a quarter wave for each diverging curvature [mm].
        determinant: |J|.
        weight: fraction of the energy of each ray.
    """

    x: Tensor
    y: Tensor
    l: Tensor
    m: Tensor
    length: Tensor
    determinant: Tensor
    weight: Tensor

    @property
    def aperture(self) -> float:
        """Largest extent of the direction cosines times the index; tiny without rays."""
        spans = [float(v.max() - v.min()) for v in (self.l, self.m) if len(v)]
        return max([*spans, 1e-6])

    def near(self, x: Tensor, y: Tensor, beyond: float) -> "_Waves":
        """Return the waves of rays that land at most `beyond` [mm] outside these points; at least one wave.

        Other waves contribute no light here, and their phase is not resolved.
        """
        dx, dy = (torch.maximum(p.min() - v, v - p.max()).clamp(min=0) for p, v in ((x, self.x), (y, self.y)))
        outside = torch.maximum(dx, dy)
        return self.select(outside <= outside.min().clamp(min=beyond)) if len(outside) else self

    def select(self, mask: Tensor) -> "_Waves":
        """Return the waves that `mask` selects."""
        return _Waves(*(getattr(self, name)[mask] for name in self.__dataclass_fields__))


def _waves(lens: Lens, view: View, field: int, channel: int, rings: int) -> _Waves:
    """Trace rays through the points of a quadrature on the whole disc: `rings` rings of 4 `rings` points."""
    half, share = gauss_quadrature(rings, 2 * rings)
    pupil, weight = torch.cat([half, half * torch.tensor([-1.0, 1.0])]), torch.cat([share, share]) / 2
    # Shifts point to the centre, so that few shifted rays are lost; the wave of such a ray is left out.
    shifts = -_SHIFT * torch.where(pupil < 0, -1.0, 1.0)
    points = torch.cat([pupil, pupil + shifts * torch.tensor([1.0, 0.0]), pupil + shifts * torch.tensor([0.0, 1.0])])
    wavelengths = (view.wavelengths_um[channel],)
    indices = lens.refractive_indices(wavelengths)
    of_field = replace(view, fields=view.fields[field : field + 1])
    start = launch_fields(lens, of_field, points, wavelengths)
    rays = trace(lens, start, indices)
    l, m = (indices[-1, 0] * v.reshape(3, -1) for v in (rays.l, rays.m))
    dl, dm = ((v[1:] - v[0]) / shifts.T for v in (l, m))
    phase = indices[0, 0] * object_path(lens, of_field, start) + rays.path
    valid = rays.valid.reshape(3, -1).all(0)
    x, y, length = (v.reshape(3, -1)[0] for v in (rays.x, rays.y, phase))
    determinant = dl[0] * dm[1] - dl[1] * dm[0]
    diverging = torch.where(determinant < 0, 1, torch.where(dl[0] + dm[1] > 0, 2, 0))
    length = length - l[0] * x - m[0] * y + 1e-3 * view.wavelengths_um[channel] / 4 * diverging
    return _Waves(x, y, l[0], m[0], length, determinant.abs(), weight).select(valid)


def _angle(cycles: Tensor) -> Tensor:
    """Return angles from -pi to pi [rad]."""
    return 2 * math.pi * (cycles - cycles.round())
