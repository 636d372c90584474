"""Violations of limits and their derivatives along many changes of a lens at once.

`constraints` defines the limits. This module writes out their chain rule, because least squares and descents need it at
every step; in numpy, whose calls on small arrays take a fifth of the time of torch's. Only the sag and slope of a
surface, the power and the chief-ray angle are nonlinear.
"""

from collections.abc import Mapping

import numpy
import torch
from numpy import ndarray
from torch import Tensor

from tasklens.design.constraints import HEIGHTS, all_margins, spaces, violation
from tasklens.optics.analysis.paraxial import paraxial_ray, powers_and_thicknesses
from tasklens.optics.aspheres import EDGE
from tasklens.optics.lens import Lens
from tasklens.optics.rays import launch
from tasklens.optics.view import View
from tasklens.settings.specification import Constraints

_HEIGHTS = HEIGHTS.numpy()


class LinearLimits:
    """Violations of the limits of a lens, in the order of `constraints.violation`, and their derivatives.

    Args:
        semi_diameter: (S,) illuminated radius on each surface [mm].
        chief: (5, F) image points x, y [mm] and direction cosines l, m, n of the chief rays of `view`.

    Attributes:
        values: (K,) violations [mm; fractions without unit; angles in rad], zero if a limit is kept.
        chief_rays: number of values of chief rays, distortion and angles; they are the last.
        angles: number of angles; they are the last of these.
    """

    def __init__(self, lens: Lens, limits: Constraints, view: View, semi_diameter: Tensor, chief: Tensor):
        self.lens, self.view, self.chief = lens, view, chief.numpy()
        x, y, *direction = chief[..., None, None]
        rays = launch(x, y, torch.zeros_like(x), *direction)
        margins = all_margins(lens, limits, view, semi_diameter, rays)
        self.values = violation(margins)
        self.angles = margins["chief_ray_angle"].numel() if "chief_ray_angle" in margins else 0
        self.chief_rays = margins["distortion"].numel() + self.angles
        smallest = float(lens.semi_diameter[lens.stop])
        self.semi, self.moves = semi_diameter.clamp(min=smallest).numpy(), (semi_diameter >= smallest).numpy()

    def along(self, changes: Mapping[str, Tensor]) -> Tensor:
        """Compute changes (K, V) of the violations for V changes of `curvature`, `thickness`, `alpha`, `semi_diameter`
        (V, S, ..) and `chief` (V, 5, F); zero for a violation that is zero.
        """
        violated = self.values > 0
        if not violated.any():
            return self.values.new_zeros(len(self.values), len(changes["thickness"]))
        d_lens = {name: change.numpy() for name, change in changes.items()}
        semi, dt, d_chief = self.semi, d_lens["thickness"], d_lens["chief"]
        d_semi = d_lens["semi_diameter"] * self.moves
        front, behind, element = (v.numpy() for v in spaces(self.lens))
        shared = numpy.maximum(semi[front], semi[behind])[:, None] * _HEIGHTS
        of_front = semi[front] >= semi[behind]
        d_shared = numpy.where(of_front, d_semi[:, front], d_semi[:, behind])[..., None] * _HEIGHTS
        rim, d_rim = semi[:, None] * _HEIGHTS, d_semi[..., None] * _HEIGHTS
        everywhere = numpy.arange(len(semi))
        # Surfaces in front of and behind each space, and the last that refracts; flat beyond the illuminated radius.
        last = self.lens.refracting_surfaces[-1]
        surfaces = numpy.concatenate([front, behind, [last]])
        heights = numpy.concatenate([shared, shared, rim[[last]]])
        d_heights = numpy.concatenate([d_shared, d_shared, d_rim[:, [last]]], 1)
        d_heights = numpy.where(heights > semi[surfaces, None], d_semi[:, surfaces, None], d_heights)
        heights = numpy.minimum(heights, semi[surfaces, None])
        d_sag = self._shape(surfaces, heights).sag_change(d_heights, d_lens)
        front_sag, back_sag, last_sag = numpy.split(d_sag, [len(front), 2 * len(front)], 1)
        vertices = dt.cumsum(1) - dt
        distance = vertices[:, behind] - vertices[:, front]
        gap = distance[..., None] + back_sag - front_sag
        slope = self._shape(everywhere, rim)
        off_axis = (self.view.radii > 0).numpy()
        fields, points = self.view.fields.numpy()[off_axis], self.chief[:2, off_axis].T
        squared = (fields**2).sum(-1)
        stretch = (points * fields).sum(-1) / squared - 1
        distortion = (d_chief[:, :2, off_axis] * fields.T).sum(1) / squared
        centre = distance[:, element]
        power, d_power = self._power(d_lens)
        rows = [
            -centre,
            centre,
            -gap[:, element],
            -gap[:, ~element],
            last_sag - dt[:, last:].sum(1)[:, None, None],
            dt.sum(1),
            numpy.sign(slope.slope) * slope.slope_change(d_rim, d_lens),
            d_power * numpy.sign(power - 1),
            distortion * numpy.sign(stretch),
        ]
        if self.angles:
            rows.append(self._angle(off_axis, d_chief))
        columns = numpy.concatenate([row.reshape(len(dt), -1) for row in rows], 1)
        return torch.from_numpy(columns).T * violated[:, None]

    def _shape(self, surfaces: ndarray, heights: ndarray) -> "_Shape":
        numbers = (v.numpy()[surfaces] for v in (self.lens.curvature, self.lens.conic, self.lens.alpha))
        return _Shape(surfaces, heights, *numbers)

    def _power(self, d_lens: Mapping[str, ndarray]) -> tuple[ndarray, ndarray]:
        """Compute the power times the focal length of the view, and its change (V,).

        Two paraxial rays p and q start from (y, n u) = (1, 0) and (0, 1). A change d of the angle of a ray at a surface
        changes its angle behind the lens by (p q' - q p') d, with the heights p and q at the surface and the angles
        p' and q' behind the lens. A shift in height acts likewise.
        """
        lens, efl = self.lens, self.view.efl
        indices = lens.refractive_indices((self.view.reference_um,))[:, 0]
        unit = torch.eye(2, dtype=lens.dtype)
        rays = paraxial_ray(*powers_and_thicknesses(lens, indices), *unit)
        height, angle = (v.numpy().T for v in rays)  # (2, S) and (2, S + 1)
        n, (p, q) = indices.numpy(), angle[:, -1]
        turn_effect = height[0] * q - height[1] * p  # effect of a unit change of angle at each surface
        shift_effect = angle[1, 1:] * p - angle[0, 1:] * q  # effect of a unit shift behind each surface
        vertex = d_lens["curvature"] + (2 * d_lens["alpha"][..., 0] if lens.alpha.shape[1] else 0)
        by_vertex = turn_effect * height[0] * (n[1:] - n[:-1])
        by_thickness = -shift_effect * angle[0, 1:] / n[1:]
        by_thickness[-1] = 0.0  # the image distance
        return -efl * p, efl * (vertex @ by_vertex + d_lens["thickness"] @ by_thickness)

    def _angle(self, off_axis: ndarray, d_chief: ndarray) -> ndarray:
        """Compute the change (V, F') of the chief ray angles off the axis, atan2(h, n) with h^2 = l^2 + m^2 [rad]."""
        l, m, n = self.chief[2:, off_axis]
        dl, dm, dn = d_chief[:, 2:, off_axis].swapaxes(0, 1)
        h = numpy.hypot(l, m)
        lost = h == 0  # a lost ray may lie along the axis
        dh = numpy.where(lost, 0.0, (l * dl + m * dm) / numpy.where(lost, 1.0, h))
        return (n * dh - h * dn) / (h**2 + n**2)


class _Shape:
    """Even aspheres (P,) at heights (P, H), as `aspheres.sag` defines them: slopes, and changes with height and shape.

    With w = sqrt(1 - (1 + k) c^2 r^2), which is constant beyond the edge of the conic:

        sag    c r^2 / (1 + w) + sum_j alpha_2j r^2j,            d sag / dc = r^2 / (w (1 + w)), beyond r^2 / (1 + w)
        slope  c r / w + sum_j 2j alpha_2j r^(2j - 1),           d slope / dc = r / w^3, beyond r / w
    """

    def __init__(self, surfaces: ndarray, heights: ndarray, curvature: ndarray, conic: ndarray, alpha: ndarray):
        self.surfaces, self.r, self.c = surfaces, heights, curvature[:, None]
        argument = 1 - (1 + conic[:, None]) * (self.c * heights) ** 2
        self.inside = argument > EDGE
        self.w = numpy.sqrt(numpy.where(self.inside, argument, EDGE))
        self.order = 2 * numpy.arange(1, alpha.shape[1] + 1)
        self.powers = heights[..., None] ** (self.order - 2)  # r^(2j - 2)
        self.terms = alpha[:, None] * self.order * self.powers  # 2j alpha_2j r^(2j - 2)
        self.slope = heights * (self.c / self.w + self.terms.sum(-1))

    def sag_change(self, d_heights: ndarray, d_lens: Mapping[str, ndarray]) -> ndarray:
        """Compute the change (V, P, H) of the sag for changes of heights (V, P, H) and of the lens."""
        r, c, w = self.r, self.c, self.w
        by_r = numpy.where(self.inside, self.slope, r * (2 * c / (1 + w) + self.terms.sum(-1)))
        by_c = r**2 / ((1 + w) * numpy.where(self.inside, w, 1.0))
        return self._change(d_heights, d_lens, by_r, by_c, self.powers * r[..., None] ** 2)

    def slope_change(self, d_heights: ndarray, d_lens: Mapping[str, ndarray]) -> ndarray:
        """Compute the change (V, P, H) of the slope; arguments as in `sag_change`."""
        w = numpy.where(self.inside, self.w**3, self.w)
        by_r = self.c / w + (self.terms * (self.order - 1)).sum(-1)
        return self._change(d_heights, d_lens, by_r, self.r / w, self.powers * self.order * self.r[..., None])

    def _change(
        self, d_heights: ndarray, d_lens: Mapping[str, ndarray], by_r: ndarray, by_c: ndarray, by_alpha: ndarray
    ) -> ndarray:
        d_alpha = (by_alpha @ d_lens["alpha"][:, self.surfaces, :, None])[..., 0]
        return by_r * d_heights + by_c * d_lens["curvature"][:, self.surfaces, None] + d_alpha
