"""Ray-space descent: steps of a design measured by the displacement of rays on the sensor.

The variables of a lens have nearly collinear effects on its rays, so that equal steps in each variable cause very
different displacements on the sensor. With a gradient g, a step d of the variables solves

    minimise  g.d + mu/2 d.(M + damping diag(M + (max(s, s0) / scale)^2)) d + w/2 |c + C d|^2,   sqrt(d.M d) = s,

where d.M d is the mean squared displacement of rays, s the step size, s0 = 3 um, `scale` a small change of a variable,
and c + C d the linearised violation of the limits: a Gauss-Newton metric as in least squares, a trust region as in
Levenberg-Marquardt. A gradient g that presses against a limit holds it violated by about g / w.
"""

from dataclasses import dataclass

import numpy
import torch
from scipy.linalg import eigh
from torch import Tensor

from tasklens.design.constraints import limit_margins, worst_margin
from tasklens.design.merit import Merit, limit_semi_diameters
from tasklens.design.variables import Free, Variables
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.settings.specification import Constraints

# Small changes: of curvature [1/mm], thickness [mm], and of alpha_2j R^(2j - 1), the slope at R up to a factor.
_SCALES = {"curvature": 0.1, "thickness": 0.05, "alpha_4": 0.03, "alpha_6": 0.02, "alpha_8": 0.015, "alpha_10": 0.01}
_DISPLACEMENT_UM = 3.0  # ray displacement equivalent to a small change, or the step size if that is larger
SOFT, HARD = 1e3, 1e5  # w [1/mm^2]: limits are soft during the descent and hard at its end
MARGINAL_RAYS = 17  # with 3, limits were violated at strongly curved rims, between the rays
_REPAIR_STEPS_UM = 1e-3, 0.25, 2.0  # shortest, first and longest step of the repair: a sharp spot has 2 um
_KEPT = 1e-9  # violation that counts as rounding, of limits with a buffer [mm]
_REPAIR_STEPS = 60  # maximum number of steps of the repair


@dataclass(frozen=True)
class LinearModel:
    """First-order model of rays and limits about a lens, in V variables.

    Attributes:
        metric: M, (V, V), quadratic form of the mean squared displacement of rays [um^2].
        scale: (V,) small changes of the variables.
        violation: c, (K,), violations of the violated limits [mm; fractions without unit].
        limits: C, (K, V), derivatives of the violations.
    """

    metric: Tensor
    scale: Tensor
    violation: Tensor
    limits: Tensor

    @property
    def violation_norm(self) -> float:
        """Norm of the violation [mm; fractions without unit]."""
        return float(self.violation.norm())

    def step(self, gradient: Tensor, step_size: float, damping: float, weight: float = SOFT) -> Tensor:
        """Compute the change (V,) of the variables with an RMS ray displacement of `step_size` [um].

        The displacement includes the repair of violated limits; the gradient uses the rest.

        Args:
            weight: weight of the squared violations [1/mm^2].
        """
        floor = (max(step_size, _DISPLACEMENT_UM) / self.scale).square()
        regular = self.metric + damping * torch.diag(self.metric.diagonal() + floor)
        curvature = weight * self.limits.T @ self.limits
        slope = gradient + weight * self.limits.T @ self.violation

        if not (regular.isfinite().all() and curvature.isfinite().all()):
            return torch.full_like(slope, torch.nan)  # the descent ends
        # In the basis in which `regular` is 1 and `curvature` is diagonal, a step is a division for each mu.
        eigenvalues, basis = eigh(curvature.numpy(), regular.numpy())
        eigenvalues = eigenvalues.clip(min=0.0)  # rounding
        along, metric = slope.numpy() @ basis, basis.T @ self.metric.numpy() @ basis

        def change(log_mu: float) -> numpy.ndarray:
            return -along / (10**log_mu + eigenvalues)

        low, high = -12.0, 8.0  # of the decadic logarithm of mu
        while high - low > 1e-3:
            middle = (low + high) / 2
            delta = change(middle)
            is_small = delta @ metric @ delta <= step_size**2
            low, high = (low, middle) if is_small else (middle, high)
        return torch.from_numpy(basis @ change(high))


class RaySpace:
    """Free variables of a lens as one vector (V,), and their linear model."""

    def __init__(self, lens: Lens, view: View, limits: Constraints, free: Free | None = None):
        self.variables = Variables.normalised(lens, view)
        self.merit = Merit(view, limits, rim=MARGINAL_RAYS)
        values = self.variables.values()
        self.names = list(values)
        self.free = self.variables.free(free)
        self.all = torch.cat(list(values.values()))
        self.start = self.all[self.free]
        directions = self.variables.directions(self.names)
        self.directions = {name: change[self.free] for name, change in directions.items()}
        scale = torch.cat([torch.full_like(value, _SCALES[name]) for name, value in values.items()])
        self.scale = scale[self.free]

    def lens(self, vector: Tensor) -> Lens:
        """Return the lens with these values (V,), differentiable in them."""
        return self.variables.assemble_vector(self.names, self.all.masked_scatter(self.free, vector))

    def linearise(self, vector: Tensor) -> LinearModel:
        """Linearise rays and limits about the lens with these values (V,)."""
        residuals, columns = self.merit.linearise(self.lens(vector))
        jacobian = columns(self.directions)
        rays, limits = jacobian.split([self.merit.rays, len(jacobian) - self.merit.rays])
        violation = residuals[self.merit.rays :]
        violated = violation > 0
        per_mm = self.merit.per_mm
        return LinearModel(rays.T @ rays, self.scale, violation[violated] / per_mm, limits[violated] / per_mm)


def repair(lens: Lens, view: View, limits: Constraints, free: Free | None = None) -> tuple[Lens, Tensor]:
    """Repair violated limits of a lens by steps of small ray displacement; a lens within its limits is unchanged.

    A repaired lens keeps all limits, at all radii of the sensor, with the buffer that designs aim at.

    Returns:
        The lens, or the one of the smallest violation if the steps do not suffice; and the semi-diameters (S,) at which
        its limits were evaluated [mm].
    """
    radii = limit_semi_diameters(lens, view)
    if worst_margin(limit_margins(lens, limits, view, torch.minimum(radii, lens.semi_diameter)))[1] < 0:
        lens = _repair(lens, view, limits, free)
        radii = limit_semi_diameters(lens, view)
    return lens, radii


def as_saved(lens: Lens, view: View, limits: Constraints, free: Free | None = None) -> Lens:
    """Return a lens as its file will hold it: repaired, and with its missing clear apertures."""
    repaired, radii = repair(lens, view, limits, free)
    return repaired.with_clear_apertures(radii)


def _repair(lens: Lens, view: View, limits: Constraints, free: Free | None) -> Lens:
    """Minimise the violation by steps; each is shortened until it reduces the violation.

    The range in which a lens is nearly linear differs between lenses. If no short step reduces the violation, for
    example because lost rays return, a long step is taken.
    """
    space = RaySpace(lens, view, limits, free)
    shortest, first, longest = _REPAIR_STEPS_UM
    vector, step_um = space.start, first
    model = space.linearise(vector)
    least, best = model.violation_norm, vector
    for _ in range(_REPAIR_STEPS):
        if least < _KEPT:
            break
        trial = vector + model.step(torch.zeros_like(vector), step_um, damping=0.1)
        trial_model = space.linearise(trial)
        if trial_model.violation_norm < model.violation_norm:
            step_um = min(2 * step_um, longest)
        elif step_um > shortest:
            step_um /= 4
            continue
        else:
            step_um = longest
        vector, model = trial, trial_model
        if model.violation_norm < least:
            least, best = model.violation_norm, vector
    return space.lens(best)
