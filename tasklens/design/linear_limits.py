"""Violations of limits and their derivatives, written out; `constraints` states the limits, and is the tests' oracle.

Least squares asks for them at every step, and autograd takes longer for them than for all rays.
"""

import math
from collections.abc import Mapping

import numpy
from numpy import ndarray
from torch import Tensor

from tasklens.design.constraints import BUFFER, HEIGHTS, buffer_scale
from tasklens.materials.material import AIR
from tasklens.optics.aspheres import EDGE
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.study.settings import Constraints


class LinearLimits:
    """Violations of the limits of a lens, in the order of `constraints.violation`, and their derivatives.

    Args:
        semi_diameter: (S,) radius that light uses on each surface [mm].
        chief: (5, F) image points x, y [mm] and direction cosines l, m, n of the chief rays of `view`.

    Attributes:
        values: (K,) violations [mm; fractions without unit; angles in rad], zero where a limit is kept.
    """

    def __init__(
        self,
        lens: Lens,
        limits: Constraints,
        view: View,
        semi_diameter: Tensor,
        chief: Tensor,
    ):
        self.c, self.t, self.alpha = (v.numpy() for v in (lens.curvature, lens.thickness, lens.alpha))
        self.bending = (1 + lens.conic.numpy()) * self.c**2
        surfaces, orders = self.alpha.shape
        self.orders = numpy.arange(1, orders + 1)
        smallest = float(lens.semi_diameter[lens.stop])
        self.semi = numpy.maximum(semi_diameter.numpy(), smallest)
        self.moves = semi_diameter.numpy() >= smallest
        # Sags of the two surfaces of each space up to the larger of their radii, and of the last one; beyond its own
        # radius a surface is flat.
        i = numpy.arange(surfaces - 1)
        larger = numpy.where(self.semi[:-1] >= self.semi[1:], i, i + 1)
        self.surface, owner = numpy.r_[i, i + 1, surfaces - 1], numpy.r_[larger, larger, surfaces - 1]
        fractions = HEIGHTS.numpy()
        heights = self.semi[owner, None] * fractions
        flat = heights > self.semi[self.surface, None]
        self.heights = numpy.where(flat, self.semi[self.surface, None], heights)
        self.owner = numpy.where(
            flat, self.surface[:, None], owner[:, None]
        )  # whose radius moves a height, and how much
        self.share = numpy.where(flat, 1.0, fractions) * self.moves[self.owner]
        self.sag_slope, self.sags = self._profile(self.surface, self.heights)
        gap = self.t[:-1, None] + self.sags[surfaces - 1 : -1] - self.sags[: surfaces - 1]
        self.rims = self.semi[:, None] * fractions
        self.radial = 2 * self.rims * self._profile(numpy.arange(surfaces), self.rims)[0]
        self.element = numpy.array([medium != AIR for medium in lens.media[:-1]])
        centre = self.t[:-1][self.element]
        self.indices = lens.refractive_indices((view.reference,))[:, 0].numpy()
        self.power, self.power_slopes = self._power(view.efl)
        self.fields = view.fields.numpy()[view.radii.numpy() > 0]
        self.off_axis = numpy.flatnonzero(view.radii.numpy() > 0)
        self.chief = chief.numpy()
        self.squared = (self.fields**2).sum(1)
        self.distortion = (self.chief[:2, self.off_axis].T * self.fields).sum(1) / self.squared - 1
        margins = {
            "min_centre_thickness": centre - limits.min_centre_thickness,
            "max_centre_thickness": limits.max_centre_thickness - centre,
            "min_edge_thickness": gap[self.element] - limits.min_edge_thickness,
            "min_air_gap": gap[~self.element] - limits.min_air_gap,
            "min_back_focus": self.t[-1] - self.sags[-1] - limits.min_back_focus,
            "max_track": limits.max_track - self.t.sum(),
            "max_slope": limits.max_slope - abs(self.radial),
            "efl_tolerance": limits.efl_tolerance - abs(self.power - 1),
            "distortion": limits.distortion - abs(self.distortion),
        }
        largest = limits.max_chief_ray_angle_deg
        self.angles = 0 if largest is None else len(self.off_axis)  # how many of the values, the last, are angles
        if largest is not None:
            l, m, n = self.chief[2:, self.off_axis]
            margins["chief_ray_angle"] = math.radians(largest) - numpy.arctan2(numpy.hypot(l, m), n)
        violations = [(BUFFER * buffer_scale(name) - margin).ravel() for name, margin in margins.items()]
        self.values = numpy.maximum(numpy.concatenate(violations), 0)

    def along(self, changes: Mapping[str, Tensor]) -> ndarray:
        """Compute changes (K, V) of the violations for V changes of `curvature`, `thickness`, `alpha`, `semi_diameter`
        (V, S, ..) and `chief` (V, 5, F); zero for a violation that is zero.
        """
        dc, dt, da = (changes[name].numpy() for name in ("curvature", "thickness", "alpha"))
        d_semi, d_chief = changes["semi_diameter"].numpy(), changes["chief"].numpy()
        surfaces = len(self.c)
        u = self.heights**2
        by_c, powers = self._by_parameters(self.surface, u)
        sag = (
            by_c * dc[:, self.surface, None]
            + numpy.einsum("vsj,shj->vsh", da[:, self.surface], powers * u[..., None])
            + self.sag_slope * 2 * self.heights * self.share * d_semi[:, self.owner]
        )
        gap = dt[:, :-1, None] + sag[:, surfaces - 1 : -1] - sag[:, : surfaces - 1]
        every = numpy.arange(surfaces)
        u = self.rims**2
        w = self._w(every, u)
        _, powers = self._by_parameters(every, u)
        slope = self._profile(every, self.rims)[0]
        curving = 0.25 * (self.bending * self.c)[:, None] * w**3
        curving = curving + (self.orders[1:] * (self.orders[1:] - 1) * self.alpha[:, None, 1:] * powers[..., :-1]).sum(
            -1
        )
        d_rim = HEIGHTS.numpy() * self.moves[:, None] * d_semi[..., None]
        d_slope = 0.5 * w**3 * dc[..., None] + numpy.einsum("vsj,shj->vsh", da * self.orders, powers)
        radial = 2 * self.rims * d_slope + (2 * slope + 4 * u * curving) * d_rim
        d_distortion = (d_chief[:, :2, self.off_axis].transpose(0, 2, 1) * self.fields).sum(2) / self.squared
        centre = dt[:, :-1][:, self.element]
        by_curvature, by_thickness = self.power_slopes
        d_power = dc @ by_curvature + dt @ by_thickness + (2 * da[..., 0] @ by_curvature if da.shape[-1] else 0)
        rows = [
            -centre,
            centre,
            -gap[:, self.element],
            -gap[:, ~self.element],
            sag[:, -1] - dt[:, -1:],
            dt.sum(1),
            numpy.sign(self.radial) * radial,
            numpy.sign(self.power - 1) * d_power,
            numpy.sign(self.distortion) * d_distortion,
        ]
        if self.angles:
            l, m, n = self.chief[2:, self.off_axis]
            dl, dm, dn = d_chief[:, 2:, self.off_axis].transpose(1, 0, 2)
            sine = numpy.maximum(numpy.hypot(l, m), 1e-12)  # a lost ray may lie along the axis
            rows.append((n * (l * dl + m * dm) / sine - sine * dn) / (sine**2 + n**2))
        return numpy.concatenate([row.reshape(len(dc), -1) for row in rows], 1).T * (self.values > 0)[:, None]

    def _w(self, surface: ndarray, u: ndarray) -> ndarray:
        return 1 / numpy.sqrt(numpy.maximum(1 - self.bending[surface, None] * u, EDGE))

    def _profile(self, surface: ndarray, heights: ndarray) -> tuple[ndarray, ndarray]:
        """Compute ds/du and the sag s of surfaces at heights (.., H)."""
        u, w, c = heights**2, self._w(surface, heights**2), self.c[surface, None]
        value, slope = numpy.zeros_like(u), numpy.zeros_like(u)
        for j in range(len(self.orders), 0, -1):
            a = self.alpha[surface, j - 1, None]
            value, slope = value * u + a, slope * u + j * a
        return 0.5 * c * w + slope, u * (c * w / (1 + w) + value)

    def _by_parameters(self, surface: ndarray, u: ndarray) -> tuple[ndarray, ndarray]:
        """Compute the derivative of the sag by the curvature, and the powers u^0 .. u^(M - 1), (.., M)."""
        w = self._w(surface, u)
        return u * w * w / (1 + w), u[..., None] ** (self.orders - 1)

    def _power(self, efl: float) -> tuple[float, tuple[ndarray, ndarray]]:
        """Compute the power times `efl`, and its derivatives by vertex curvatures and thicknesses.

        A change d of a surface's power turns a marginal ray of height y by -y d, and a change d of a space raises it by
        u d; (a, b) is what a change of reduced angle or height there makes of the reduced angle behind the lens.
        """
        steps, n = numpy.diff(self.indices), self.indices
        strength = steps * (self.c + (2 * self.alpha[:, 0] if self.alpha.shape[1] else 0))
        y, angle = 1.0, 0.0
        heights, slopes = [], []
        for i, power in enumerate(strength):
            heights.append(y)
            angle -= y * power
            slopes.append(angle / n[i + 1])
            y += slopes[-1] * self.t[i]
        a, b = 1.0, 0.0
        by_curvature, by_thickness = numpy.zeros_like(self.c), numpy.zeros_like(self.c)
        for i in range(len(strength) - 1, -1, -1):
            by_thickness[i] = -b * slopes[i]
            a = a + b * self.t[i] / n[i + 1]
            by_curvature[i] = a * heights[i] * steps[i]
            b = b - a * strength[i]
        return -angle * efl, (by_curvature * efl, by_thickness * efl)
