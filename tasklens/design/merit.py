"""Merit function of damped least squares: two residuals per ray and one per limit, with derivatives."""

import math
from collections.abc import Callable, Mapping
from typing import Literal

import torch
from torch import Tensor

from tasklens.design.linear_limits import LinearLimits
from tasklens.optics.analysis.aiming import stop_is_inside
from tasklens.optics.analysis.continuation import stop_is_curved
from tasklens.optics.analysis.pupil import gauss_quadrature, launch_fields
from tasklens.optics.analysis.spots import OUTLINE, clear_semi_diameters
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.tracing.trace import linearise
from tasklens.optics.view import View
from tasklens.settings.specification import Constraints

# Fields as fractions of the largest.
FIELD_HEIGHTS = (0.0, 0.25, 0.45, 0.65, 0.88, 1.0)
RINGS, ARMS = 8, 6  # with 6 x 4, true corner spots were twice the optimised ones
_APERTURE_RESERVE = 1.01  # clear semi-diameter / radius that the rays of the merit function use
_LOST_RAY_UM = 300.0  # residual of a lost ray
VIOLATION_UM_PER_MM = 1000.0  # residual per mm of violation: 1 um of violation weighs as much as an RMS spot of 1 um


class Merit:
    """Residuals of a lens [um]: two per ray, whose sum of squares is the mean squared spot radius, then limits.

    Rays are launched to fill a plane stop in front of the lens. Otherwise they are launched again for every lens.
    The derivatives neglect the change of the aim; each step is checked at its new lens. Limits of chief rays hold at
    all radii of the sensor: between the fields of the spots distortion exceeded its limit.

    Args:
        reference: reference point of the rays' errors in y.
        corner_weight: weight of the corner field, geometric from 1 on the axis.
        per_mm: residual per mm of violation, or per unit of a violation without a unit [um/mm].
        angle_weight: factor on the residuals of chief ray angles.
        rim: number of rim rays on half the pupil edge, for the illuminated radii.
    """

    def __init__(
        self,
        view: View,
        limits: Constraints,
        reference: Literal["pinhole", "centroid", "chief_ray"] = "pinhole",
        corner_weight: float = 1.0,
        per_mm: float = VIOLATION_UM_PER_MM,
        angle_weight: float = 1.0,
        rim: int = 3,
    ):
        heights = torch.tensor(FIELD_HEIGHTS, dtype=torch.float64)
        self.view, self.limits = view.along_y(view.radii.max() * heights), limits
        self.reference = reference
        pupil, self.weight = gauss_quadrature(RINGS, ARMS)
        azimuth = torch.linspace(0, torch.pi, rim, dtype=torch.float64)
        marginal = torch.stack([azimuth.sin(), azimuth.cos()], -1)
        self.pupil = torch.cat([pupil, marginal, torch.zeros_like(pupil[:1])])  # the last ray is the chief ray
        self.all_radii = (
            view.at_all_radii()
        )  # their chief rays are traced behind the rays of each field, a part by each
        self.chief_weight = math.sqrt(len(heights) / len(self.all_radii.fields))  # together as much as at the fields
        self.middle = len(view.wavelengths_um) // 2
        field = corner_weight**heights
        self.of_field = (field / field.sum() / len(view.wavelengths_um))[:, None, None]
        self.keep(torch.ones(len(heights), len(view.wavelengths_um), len(self.weight), dtype=torch.bool))
        # Number of ray residuals; those of limits follow.
        self.rays = 2 * len(heights) * len(view.wavelengths_um) * len(self.weight)
        self.per_mm, self.angle_weight = per_mm, angle_weight
        self.launched: tuple[float, Rays] | None = None  # radius of the stop, and rays

    def keep(self, mask: Tensor) -> None:
        """Omit rays (F, W, N) of the quadrature from the spots if `mask` is false."""
        weight = mask * self.weight
        self.weights = weight / weight.sum(-1, keepdim=True)
        self.share = torch.sqrt(self.of_field * self.weights)

    def residuals(self, lens: Lens) -> Tensor:
        """Compute the (R,) residuals [um]."""
        return self.linearise(lens)[0]

    def spot_um(self, residuals: Tensor) -> float:
        """Compute the mean RMS spot radius of the fields [um] from the residuals (R,)."""
        squares = residuals[: self.rays].reshape(2, len(self.of_field), -1).square().sum((0, 2))
        spots = (squares / (self.of_field[:, 0, 0] * len(self.view.wavelengths_um))).sqrt()
        return float(spots.mean())

    def linearise(self, lens: Lens) -> tuple[Tensor, Callable[[Mapping[str, Tensor]], Tensor]]:
        """Return residuals (R,) [um], and a function from V changes of the lens (as in `tracing`) to (R, V) columns."""
        view = self.view
        rays, traces, derivative = linearise(lens, self._launch(lens), lens.refractive_indices(view.wavelengths_um))
        valid = rays.valid[..., : len(self.weight)]
        x, y = self._errors(rays.x, rays.y, valid, change=False)
        scale = torch.where(valid, 1e3 * self.share, 0.0)
        errors = [torch.where(valid, scale * error, _LOST_RAY_UM * self.share) for error in (x, y)]
        outermost = [_outermost(surface_rays) for surface_rays in traces]
        chief = torch.stack([self._chief(v) for v in (rays.x, rays.y, rays.l, rays.m, rays.n)])
        points, farthest = torch.stack([torch.stack(point) for *point, _ in outermost]), [i for *_, i in outermost]
        radii = torch.hypot(*points.T)
        operands = LinearLimits(lens.detached(), self.limits, self.all_radii, _APERTURE_RESERVE * radii, chief)
        weight = torch.full((len(operands.values),), self.per_mm, dtype=lens.dtype)
        weight[len(weight) - operands.chief_rays :] *= self.chief_weight
        weight[len(weight) - operands.angles :] *= self.angle_weight
        values = torch.cat([*(error.flatten() for error in errors), weight * operands.values])

        def columns(changes: Mapping[str, Tensor]) -> Tensor:
            (dx, dy, dl, dm, dn), changes_behind = derivative(changes)
            rows = [(scale * change).flatten(1) for change in self._errors(dx, dy, valid, change=True)]
            chief = torch.stack([self._chief(v) for v in (dx, dy, dl, dm, dn)], 1)
            at_farthest = changes_behind.flatten(3)[:, range(len(points)), :, farthest]  # (S, V, 2)
            apertures = _APERTURE_RESERVE * (at_farthest * points[:, None]).sum(-1).T / radii
            limit_columns = operands.along({**changes, "chief": chief, "semi_diameter": apertures})
            rows.append((weight[:, None] * limit_columns).T)
            return torch.cat(rows, 1).T.nan_to_num_(0.0, 0.0, 0.0)

        # A perturbed lens can have residuals that are not finite; scipy does not accept them.
        return torch.nan_to_num(values, 1e6, 1e6, -1e6), columns

    def _launch(self, lens: Lens) -> Rays:
        """Launch the rays; all lenses with the same plane stop in front share them."""
        if stop_is_inside(lens) or stop_is_curved(lens):
            return self._bundles(lens.detached())
        radius = float(lens.semi_diameter[lens.stop])
        if self.launched is None or self.launched[0] != radius:
            self.launched = radius, self._bundles(lens)
        return self.launched[1]

    def _bundles(self, lens: Lens) -> Rays:
        """Launch the rays of the fields (F, W, N), and behind each the chief rays of a part of all radii."""
        rays = launch_fields(lens, self.view, self.pupil)
        chief = launch_fields(lens, self.all_radii, self.pupil[-1:], (self.view.reference_um,))
        size = (*rays.x.shape[:2], -1)
        parts = ((getattr(rays, key), value.reshape(size[0], 1, -1).expand(size)) for key, value in vars(chief).items())
        return Rays(*(torch.cat(pair, -1) for pair in parts))

    def _chief(self, values: Tensor) -> Tensor:
        """Return the part (.., R) of ray values (.., F, W, N) that is of the chief rays at all radii."""
        return values[..., self.middle, len(self.pupil) :].flatten(-2)

    def _errors(self, x: Tensor, y: Tensor, valid: Tensor, change: bool) -> tuple[Tensor, Tensor]:
        """Compute errors [mm] in x, and in y about the reference, of the rays of the quadrature; or their change."""
        count = len(self.weight)
        match self.reference:
            case "centroid":
                weights = valid * self.weights
                centre = (y[..., :count] * weights).sum((-2, -1)) / weights.sum((-2, -1)).clamp(min=1e-12)
            case "chief_ray":
                centre = y[..., self.middle, len(self.pupil) - 1]
            case "pinhole":
                centre = torch.zeros_like(self.view.fields[:, 1]) if change else self.view.fields[:, 1]
        return x[..., :count], y[..., :count] - centre[..., None, None]


def limit_semi_diameters(lens: Lens, view: View) -> Tensor:
    """Compute the semi-diameters (S,) at which limits are evaluated: 1 % more than rays of all radii use [mm]."""
    pupil = torch.cat([gauss_quadrature(RINGS, ARMS)[0], OUTLINE])
    return _APERTURE_RESERVE * clear_semi_diameters(lens.detached(), view.at_all_radii(), pupil)


def _outermost(rays: Rays) -> tuple[Tensor, Tensor, int]:
    """Return the point (x, y) [mm] and the flat index of the ray farthest from the axis, among those not lost."""
    heights = torch.where(rays.lost_at < 0, torch.hypot(rays.x, rays.y), 0.0).flatten()
    i = int(heights.argmax())
    return rays.x.flatten()[i], rays.y.flatten()[i], i
