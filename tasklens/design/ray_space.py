"""Steps of a design that are measured by how far they move rays on the sensor.

The parameters of a lens act on its rays in nearly the same few ways, so that equal steps in each are very unequal on
the sensor. With a gradient g, a step d of the variables solves

    minimise  g.d + mu/2 d.(M + damping diag(M + (s / scale)^2)) d + w/2 |c + C d|^2,   sqrt(d.M d) = s,

where d.M d is the mean squared displacement of rays, s the step size, `scale` a change that is small for a variable,
and c + C d the linearised violation of the limits: a Gauss-Newton metric as in least squares, a trust region as in
Levenberg-Marquardt.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tasklens.design.merit import Merit
from tasklens.design.variables import Variables
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.study.settings import Constraints

# Small changes: of curvature [1/mm], thickness [mm], and of alpha_2j R^(2j - 1), the slope at R up to a factor.
_SCALES = {"curvature": 0.1, "thickness": 0.05, "alpha_4": 0.03, "alpha_6": 0.02, "alpha_8": 0.015, "alpha_10": 0.01}
_DISPLACEMENT_UM = 3.0  # ray displacement that costs as much as a small change, or the step size where that is longer
_LIMIT_WEIGHT = 1000.0  # w [1/mm^2]
_MARGINAL_RAYS = 17  # a classifier bends the rim, and with 3 lost limits where none of them went
_REPAIR_STEP_UM = 2.0  # step size of the steps that bring a lens back within its limits
_REPAIR_STEPS = 20  # of them at most


@dataclass(frozen=True)
class LinearModel:
    """Rays and limits about a lens, to first order in V variables.

    Attributes:
        metric: M, (V, V), mean squared displacement of the rays [um^2].
        scale: (V,) small changes.
        violation: c, (K,), of the violated limits [mm; fractions without unit].
        limits: C, (K, V), their derivatives.
    """

    metric: Tensor
    scale: Tensor
    violation: Tensor
    limits: Tensor

    @property
    def violation_norm(self) -> float:
        """Length of the violation."""
        return float(self.violation.norm())

    def step(self, gradient: Tensor, step_size: float, damping: float) -> Tensor:
        """The change (V,) of the variables that moves rays by `step_size` [um] RMS.

        Repairing violated limits is part of the step, never on top of it. Where it needs less than the whole of it, the
        gradient has the rest.
        """
        floor = (max(step_size, _DISPLACEMENT_UM) / self.scale).square()
        regular = self.metric + damping * torch.diag(self.metric.diagonal() + floor)
        curvature = _LIMIT_WEIGHT * self.limits.T @ self.limits
        slope = gradient + _LIMIT_WEIGHT * self.limits.T @ self.violation

        def change(log_mu: float) -> Tensor:
            return -torch.linalg.solve_ex(10**log_mu * regular + curvature, slope)[0]

        log_mu = _bisect(lambda value: float(change(value) @ self.metric @ change(value)) <= step_size**2)
        return change(log_mu)


class RaySpace:
    """The variables of a lens as one vector, with what they do to its rays and limits."""

    def __init__(self, lens: Lens, view: View, limits: Constraints):
        self.variables = Variables.normalised(lens, view)
        self.merit = Merit(view, limits, rim=_MARGINAL_RAYS)
        values = self.variables.values()
        self.names = list(values)
        self.start = torch.cat(list(values.values()))
        self.directions = self.variables.directions(self.names)
        self.scale = torch.cat([torch.full_like(value, _SCALES[name]) for name, value in values.items()])

    def lens(self, vector: Tensor) -> Lens:
        """The lens with these values (V,), differentiable in them."""
        return self.variables.assemble_vector(self.names, vector)

    def linearise(self, vector: Tensor) -> LinearModel:
        """Rays and limits about the lens with these values."""
        residuals, columns = self.merit.linearise(self.lens(vector))
        jacobian = columns(self.directions)
        rays, limits = jacobian.split([self.merit.rays, len(jacobian) - self.merit.rays])
        violation = residuals[self.merit.rays :]
        violated = violation > 0
        per_mm = self.merit.per_mm
        return LinearModel(rays.T @ rays, self.scale, violation[violated] / per_mm, limits[violated] / per_mm)


def repair(lens: Lens, view: View, limits: Constraints) -> tuple[Lens, Tensor]:
    """Bring a lens back within its limits by steps that move its rays as little as that takes.

    If they end before it is, the one of least violation.

    Returns:
        The lens, and the apertures (S,) within which it keeps its limits [mm].
    """
    space = RaySpace(lens, view, limits)
    vector = space.start
    found = []
    for k in range(_REPAIR_STEPS):
        model = space.linearise(vector)
        found.append((model.violation_norm, k, vector))
        if not model.violation_norm:
            break
        vector = vector + model.step(torch.zeros_like(vector), _REPAIR_STEP_UM, damping=0.1)
    lens = space.lens(min(found, key=lambda entry: entry[:2])[2])
    return lens, space.merit.clear_semi_diameters(lens)


def _bisect(holds: Callable[[float], bool], low: float = -12.0, high: float = 8.0) -> float:
    """The least value within 1e-3, to the right of which `holds` is true."""
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
