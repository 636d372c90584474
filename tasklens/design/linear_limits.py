"""Violations of limits and their derivatives along many changes of a lens at once.

`constraints` defines the limits. This module writes out their chain rule, because least squares needs it at every step.
Only the sag and slope of a surface, the power and the chief-ray angle are nonlinear. They are elementwise, so that one
backward pass gives their derivatives at all heights.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from tasklens.design.constraints import (
    HEIGHTS,
    all_margins,
    chief_ray_angle,
    spaces,
    violation,
)
from tasklens.optics.analysis.paraxial import paraxial_ray, powers_and_thicknesses
from tasklens.optics.aspheres import radial_slope, sag
from tasklens.optics.lens import Lens
from tasklens.optics.rays import launch
from tasklens.optics.view import View
from tasklens.settings.specification import Constraints


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
        self.lens, self.view, self.chief = lens, view, chief
        x, y, *direction = chief[..., None, None]
        rays = launch(x, y, torch.zeros_like(x), *direction)
        margins = all_margins(lens, limits, view, semi_diameter, rays)
        self.values = violation(margins)
        self.angles = margins["chief_ray_angle"].numel() if "chief_ray_angle" in margins else 0
        self.chief_rays = margins["distortion"].numel() + self.angles
        smallest = float(lens.semi_diameter[lens.stop])
        self.semi, self.moves = semi_diameter.clamp(min=smallest), semi_diameter >= smallest

    def along(self, changes: Mapping[str, Tensor]) -> Tensor:
        """Compute changes (K, V) of the violations for V changes of `curvature`, `thickness`, `alpha`, `semi_diameter`
        (V, S, ..) and `chief` (V, 5, F); zero for a violation that is zero.
        """
        lens, semi, dt = self.lens, self.semi, changes["thickness"]
        d_semi = changes["semi_diameter"] * self.moves
        front, behind, element = spaces(lens)
        shared = torch.maximum(semi[front], semi[behind])[:, None] * HEIGHTS
        d_shared = torch.where(semi[front] >= semi[behind], d_semi[:, front], d_semi[:, behind])[..., None] * HEIGHTS
        rim, d_rim = semi[:, None] * HEIGHTS, d_semi[..., None] * HEIGHTS
        all_surfaces = torch.arange(len(semi))
        # Surfaces in front of and behind each space, and the last one; flat beyond the illuminated radius.
        surfaces = torch.cat([front, behind, all_surfaces[-1:]])
        heights, d_heights = torch.cat([shared, shared, rim[-1:]]), torch.cat([d_shared, d_shared, d_rim[:, -1:]], 1)
        d_heights = torch.where(heights > semi[surfaces, None], d_semi[:, surfaces, None], d_heights)
        heights = torch.minimum(heights, semi[surfaces, None])
        _, d_sag = self._change(lambda r, *shape: sag(r**2, *shape)[0], surfaces, heights, d_heights, changes)
        front_sag, back_sag, last_sag = d_sag.split([len(front), len(behind), 1], 1)
        vertices = dt.cumsum(1) - dt
        distance = vertices[:, behind] - vertices[:, front]
        gap = distance[..., None] + back_sag - front_sag
        slope, d_slope = self._change(radial_slope, all_surfaces, rim, d_rim, changes)
        off_axis = self.view.radii > 0
        fields, points = self.view.fields[off_axis], self.chief[:2, off_axis].T
        squared = fields.square().sum(-1)
        stretch = (points * fields).sum(-1) / squared - 1
        distortion = (changes["chief"][:, :2, off_axis].mT * fields).sum(-1) / squared
        centre = distance[:, element]
        power, d_power = self._power(changes)
        rows = [
            -centre,
            centre,
            -gap[:, element],
            -gap[:, ~element],
            last_sag - dt[:, -1:, None],
            dt.sum(1),
            slope.sign() * d_slope,
            d_power * (power - 1).sign(),
            distortion * stretch.sign(),
        ]
        if self.angles:
            rows.append(self._angle(off_axis, changes["chief"]))
        return torch.cat([row.reshape(len(dt), -1) for row in rows], 1).T * (self.values > 0)[:, None]

    def _change(
        self, function: Callable[..., Tensor], surfaces: Tensor, heights: Tensor, d_heights: Tensor, changes: Mapping
    ) -> tuple[Tensor, Tensor]:
        """Compute a function (P, H) of height, curvature, conic and alpha of `surfaces` (P,), and its change."""
        lens, size = self.lens, heights.shape
        shape = lens.curvature[surfaces, None], lens.conic[surfaces, None], lens.alpha[surfaces, None]
        leaves = [heights, shape[0].expand(size), shape[2].expand(*size, -1)]
        leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
        with torch.enable_grad():
            value = function(leaves[0], leaves[1], shape[1], leaves[2])
        by_height, by_c, by_alpha = torch.autograd.grad(value.sum(), leaves)
        d_alpha = torch.einsum("vsj,shj->vsh", changes["alpha"][:, surfaces], by_alpha)
        return value.detach(), by_height * d_heights + by_c * changes["curvature"][:, surfaces, None] + d_alpha

    def _power(self, changes: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Compute the power times the focal length of the view, and its change (V,).

        Two paraxial rays p and q start from (y, n u) = (1, 0) and (0, 1). A change d of the angle of a ray at a surface
        changes its angle behind the lens by (p q' - q p') d, with the heights p and q at the surface and the angles
        p' and q' behind the lens. A shift in height acts likewise.
        """
        lens, efl = self.lens, self.view.efl
        indices = lens.refractive_indices((self.view.reference_um,))[:, 0]
        unit = torch.eye(2, dtype=lens.dtype)
        heights, angles = paraxial_ray(*powers_and_thicknesses(lens, indices), *unit)
        height, angle = heights.mT, angles.mT  # (2, S) and (2, S + 1)
        p, q = angle[:, -1]
        turn_effect = height[0] * q - height[1] * p  # effect of a unit change of angle at each surface
        shift_effect = angle[1, 1:] * p - angle[0, 1:] * q  # effect of a unit shift behind each surface
        vertex = changes["curvature"] + (2 * changes["alpha"][..., 0] if lens.alpha.shape[1] else 0)
        by_vertex = turn_effect * height[0] * (indices[1:] - indices[:-1])
        by_thickness = -shift_effect * angle[0, 1:] / indices[1:]
        by_thickness[-1] = 0.0  # the image distance
        return -efl * p, efl * (vertex @ by_vertex + changes["thickness"] @ by_thickness)

    def _angle(self, off_axis: Tensor, d_chief: Tensor) -> Tensor:
        """Compute the change (V, F') of the chief ray angles off the axis [rad]."""
        direction = self.chief[2:, off_axis].detach().clone().requires_grad_()
        with torch.enable_grad():
            angle = chief_ray_angle(*direction).sum()
        (slope,) = torch.autograd.grad(angle, direction)
        return (torch.nan_to_num(slope) * d_chief[:, 2:, off_axis]).sum(1)  # a lost ray may lie along the axis
