"""PSFs over a whole sensor, traced at the nodes of a grid for `blend`.

The lens is rotationally symmetric, and so are its PSFs: one quadrant of the sensor is traced, the others are its mirror
images. The node spacing follows the change of the PSF: between neighbouring nodes, half of the light moves by at most
`_MOTION` pixels relative to the chief ray, measured with rays along a radius. Near the corner this may need a node
every ten pixels; near the axis, one in twenty is enough. The nodes form a grid, so each column has the
largest density that any of its rows needs.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from tasklens.camera.blend import SensorPsfs
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.object_points import image_scale
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, chief_rays, has_light, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.optics.rays import RayStatus
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.runtime.progress import Progress

_MOTION = 0.4  # of the light between neighbouring nodes [pixels]
_NEAREST = 8.0  # minimum node spacing [pixels]
_FARTHEST = 0.02  # maximum node spacing, as a fraction of centre to corner: vignetting changes little
_CORE = 75  # width of the core window [pixels]
_HALO, _HALO_PIXEL = 101, 4  # width of the halo window [halo pixels], and of a halo pixel [pixels]
_AT_ONCE = 4  # fields traced at once, so that they fit in the cache
_EXTENTS = 1.25, 1.6, 2.0, 3.0, 5.0  # largest trial fields of a lens with distortion, over that of the corner
_RADII = 129  # radii at which the change of the PSF over the field is measured
_NEGLIGIBLE = 1e-6  # fraction of the light
_SMALLER = "give a smaller field of view (--field-of-view); with true pixels, a smaller pixel pitch or a smaller image"
_NOMINAL = 0.02  # a sensor's diagonal may exceed that of its pixels by this: 1080 x 1920 of 1.8 um on 4 mm


def pitch_on_sensor(lens: Lens, view: View, shape: tuple[int, int]) -> float:
    """Return the pixel pitch [um] at which an image of H x W pixels fills the sensor, for any aspect ratio.

    It is the pitch of the view if the image has the sensor's number of pixels on the diagonal, or up to 2 % fewer; if
    not, the pitch at which the image diagonal equals the sensor diagonal (twice the paraxial image height of the
    largest field).
    """
    height = float(view.radii.max()) * abs(float(image_scale(lens.detached(), view)))
    if not height:
        raise InputError("the lens has no field except the axis; give a field of view, or the pixel pitch of the image")
    filling = 2e3 * height / math.hypot(*shape)
    return view.pixel_pitch_um if 1 <= filling / view.pixel_pitch_um <= 1 + _NOMINAL else filling


class _FieldMap:
    """Map from distance to the sensor centre to field: as in a pinhole camera, or with the distortion of the lens.

    Args:
        radius: largest distance [mm].

    Attributes:
        heights: distances [mm].
        fields: distances [mm] from the axis of the fields imaged at these heights.
        image_scale: ratio of the distances of a field's paraxial image and of the field.

    Raises:
        InputError: a chief ray does not reach the sensor, or two chief rays reach the same point.
    """

    def __init__(self, lens: Lens, view: View, radius: float, distortion: bool):
        self.heights = torch.linspace(0, radius, _RADII, dtype=torch.float64)
        self.image_scale = float(image_scale(lens.detached(), view))
        self.fields = self.heights / self.image_scale
        for extent in _EXTENTS if distortion else (1.0,):
            trial_fields = torch.linspace(0, extent * radius / self.image_scale, 2 * _RADII, dtype=torch.float64)
            chief = chief_rays(lens.with_open_apertures(), view.along_y(trial_fields))
            image_heights = chief.y[:, 0, 0]
            rising = chief.valid[:, 0, 0] & (torch.diff(image_heights, prepend=image_heights[:1] - 1) > 0)
            count = int(rising.int().cumprod(0).sum())
            heights = image_heights[:count] if distortion else self.image_scale * trial_fields[:count]
            if count < len(trial_fields) or heights[-1] >= radius:  # the end of the image, or far enough
                break
        if not count or heights[-1] < radius * (1 - 1e-9):
            raise InputError(
                f"the lens has an image up to {float(heights.max()) if count else 0:.3f} mm from the axis, and the "
                f"image to simulate has corners at {radius:.3f} mm; {_SMALLER}"
            )
        if distortion:
            self.fields = interpolate(self.heights, heights, trial_fields[:count])

    def scale(self, height: Tensor) -> Tensor:
        """Return the ratio field / height at distances `height` [mm] from the centre."""
        safe = height.clamp(min=float(self.heights[1]))
        return self.at(safe, self.fields) / safe

    def at(self, height: Tensor, values: Tensor) -> Tensor:
        """Interpolate values at `heights` to other distances from the centre."""
        return interpolate(height, self.heights, values)


def interpolate(x: Tensor, knots: Tensor, values: Tensor) -> Tensor:
    """Interpolate linearly between values (N,) at increasing knots (N,), constant outside; differentiable in both."""
    upper = torch.searchsorted(knots.detach(), x.detach().contiguous()).clamp(1, len(knots) - 1)
    low, high = knots[upper - 1], knots[upper]
    return torch.lerp(values[upper - 1], values[upper], ((x - low) / (high - low)).clamp(0, 1))


def trace_sensor_psfs(
    lens: Lens,
    view: View,
    shape: tuple[int, int],
    pixel_pitch: float,
    rays: int = 4096,
    distortion: bool = False,
    illumination: bool = False,
) -> SensorPsfs:
    """Trace the PSFs of a lens over a sensor of H x W pixels, centred on the axis; differentiable in the lens.

    The optional relative illumination has no derivatives. PSFs are centred on the chief ray, and normalised to the
    light that is not vignetted.

    Args:
        pixel_pitch: pixel pitch [um].
        rays: number of pupil points for each PSF and colour.
        distortion: whether the lens distorts the image.
        illumination: whether the relative illumination of the lens darkens the capture.

    Raises:
        InputError: the lens has tilted surfaces, or forms no image or sends no light to some part of the sensor.
    """
    if lens.pose is not None:
        raise InputError("lens with shifted or tilted surfaces: expected a rotationally symmetric one")
    if min(shape) < _CORE // 2:
        raise InputError(
            f"image of {shape[0]} x {shape[1]} pixels: too small for PSFs of {_CORE}; expected {_CORE // 2} at least"
        )
    half = [(pixels - 1) / 2 for pixels in shape]
    field_map = _FieldMap(lens, view, math.hypot(*half) * pixel_pitch / 1e3, distortion)
    light = has_light(lens.detached(), view.along_y(field_map.fields.detach()))
    if not light.all():
        dark = float(field_map.heights[~light].min())
        raise InputError(
            f"no light arrives {dark:.3f} mm from the axis of the sensor, where its image ends; {_SMALLER}"
        )
    y, x = _nodes(lens, view, half, pixel_pitch, field_map)
    pupil = sobol_disc(rays, seed=0)
    halo_size = 2 * min(_HALO // 2, min(shape) // _HALO_PIXEL) + 1
    core, halo = [], []
    progress = Progress("PSFs over the sensor", len(y))
    for step, row in enumerate(y, 1):
        points = torch.stack([x, row.expand_as(x)], -1) * (pixel_pitch / 1e3)
        row_view = replace(view, fields=points * field_map.scale(points.norm(dim=-1))[:, None])
        parts = [replace(row_view, fields=fields) for fields in row_view.fields.split(_AT_ONCE)]
        pairs = [_core_and_halo(lens, part, pupil, pixel_pitch, halo_size) for part in parts]
        core.append(torch.cat([pair[0] for pair in pairs]))
        halo.append(torch.cat([pair[1] for pair in pairs]))
        progress(step)
    halos = torch.stack(halo)
    halo.clear()  # frees a third of the memory
    negligible = bool(halos.detach().sum((-2, -1)).amax() < _NEGLIGIBLE)
    source = brightness = None
    if distortion or illumination:
        rows, columns = ((torch.arange(n) - h) * (pixel_pitch / 1e3) for n, h in zip(shape, half, strict=True))
        radius = torch.hypot(rows[:, None].double(), columns.double())
        if distortion:
            unit = torch.stack(torch.broadcast_tensors(columns / (shape[1] / 2), rows[:, None] / (shape[0] / 2)), -1)
            scale = field_map.image_scale * field_map.scale(radius)
            source = (unit * (1e3 / pixel_pitch) * scale[..., None]).float()
        if illumination:
            values = relative_illumination(lens.detached(), view.along_y(field_map.fields.detach()))
            brightness = field_map.at(radius, values).float()
    return SensorPsfs(shape, y, x, torch.stack(core), None if negligible else halos, _HALO_PIXEL, source, brightness)


def _core_and_halo(lens: Lens, view: View, pupil: Tensor, pitch: float, halo_size: int) -> tuple[Tensor, Tensor]:
    """Trace the PSFs (F, 3, K, K) and (F, 3, M, M) of the fields of a view."""
    rays, centre = trace_fields(lens, view, pupil), chief_points(lens, view)
    transmission = (~rays.vignetted).to(lens.dtype).mean(-1).clamp(min=1 / len(pupil))[..., None, None]
    offset = torch.stack([rays.x, rays.y], -1) - centre[:, None, None]
    inside = offset.detach().abs().amax(-1) <= (_CORE // 2) * pitch / 1e3  # all four pixels of such a ray
    vignetted = RayStatus.VIGNETTED
    core_rays = replace(rays, status=rays.status.masked_fill(~inside, vignetted))
    core = psf(core_rays, centre, pitch, _CORE) / transmission
    if not bool((rays.valid & ~inside).any()):
        return core.float(), core.new_zeros(*core.shape[:2], halo_size, halo_size).float()
    halo_rays = replace(rays, status=rays.status.masked_fill(inside, vignetted))
    return core.float(), (psf(halo_rays, centre, pitch * _HALO_PIXEL, halo_size) / transmission).float()


def _nodes(lens: Lens, view: View, half: list[float], pitch: float, field_map: _FieldMap) -> list[Tensor]:
    """Return the distances of the nodes from the centre [pixels], along y and along x."""
    radius = field_map.heights * (1e3 / pitch)
    radial = view.along_y(field_map.fields.detach())
    rays = trace_fields(lens.detached(), radial, sobol_disc(256, seed=0))
    chief = chief_points(lens.detached(), radial)
    offset = (torch.stack([rays.x, rays.y], -1) - chief[:, None, None]) * (1e3 / pitch)
    between = radius.diff()
    motion = offset.diff(dim=0).norm(dim=-1) / between[:, None, None]  # along the radius, per pixel of field
    turn = offset[1:].norm(dim=-1) / radius[1:, None, None]  # across the radius, the PSF rotates about the axis
    valid = rays.valid[1:] & rays.valid[:-1]
    rate = torch.maximum(*(torch.where(valid, v, torch.nan).flatten(1).nanmedian(-1).values for v in (motion, turn)))
    farthest = max(_NEAREST, _FARTHEST * math.hypot(*half))
    density = (rate.nan_to_num() / _MOTION).clamp(1 / farthest, 1 / _NEAREST)
    nodes = []
    for extent, other_extent in (half, half[::-1]):
        position = torch.linspace(0, extent, 8 * _RADII, dtype=torch.float64)
        on_line = (radius[1:] >= position[:, None]) & (
            radius[:-1] <= torch.hypot(position, position.new_tensor(other_extent))[:, None]
        )
        largest = torch.where(on_line, density, 0).amax(-1)
        count = torch.cat([position[:1], torch.cumsum((largest[1:] + largest[:-1]) / 2 * position[1], 0)])
        numbers = torch.linspace(0, float(count[-1]), math.ceil(float(count[-1])) + 1, dtype=torch.float64)
        nodes.append(interpolate(numbers, count, position))
    return nodes
