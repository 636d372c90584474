"""Imaging design by damped least squares: ray residuals, random starts, staged variables, kicks.

The way of a lens designer: many paraxial starts are sorted by a merit function of two residuals per ray; the best are
improved in stages (curvatures and spaces, then low orders, then all), and the winner is kicked out of its minimum again
and again, as in Hammer optimisation. Budgets count evaluations, so that the result does not depend on the machine.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy
import torch
from scipy.optimize import least_squares
from torch import Tensor

from tasklens.design.constraints import first_order_margins, manufacturing_margins, shortfall
from tasklens.design.start import ORDERS, Variables
from tasklens.optics.analysis import View, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.materials import AIR
from tasklens.optics.paraxial import paraxial
from tasklens.optics.pupil import gauss_quadrature
from tasklens.progress import Progress
from tasklens.settings import Constraints, LeastSquares

_HEIGHTS = (0.0, 0.3, 0.5, 0.7, 0.87, 1.0)  # fields of the merit function, as parts of the largest
_RINGS, _ARMS = 6, 4
_RIM = 1.04  # the outermost ring of the quadrature, at 0.966 of the pupil, to its rim
_LOST = 300.0  # residual of a lost ray [um]
_SHORTFALL = 1000.0  # residual per mm of broken limit: 1 um counts as much as a ray error of 1 um over all rays
_SPACES = 0.35  # a random start draws its element and air thicknesses below this part of the focal length
_KICK_EVALUATIONS = 12


@dataclass(frozen=True)
class Merit:
    """Residuals [um] of a lens: two per ray, weighted so that their sum of squares is the mean squared spot radius."""

    view: View
    limits: Constraints
    settings: LeastSquares

    def _view(self) -> View:
        """Fields along y at the heights of the merit function."""
        largest = self.view.fields.norm(dim=-1).max()
        fields = torch.stack([torch.zeros(len(_HEIGHTS), dtype=torch.float64), largest * torch.tensor(_HEIGHTS)], -1)
        return replace(self.view, fields=fields)

    def residuals(self, lens: Lens) -> Tensor:
        view = self._view()
        pupil, weight = gauss_quadrature(_RINGS, _ARMS)
        chief_ray = torch.zeros(1, 2, dtype=torch.float64)
        pupil = torch.cat([pupil, chief_ray])  # the last ray of each bundle
        record: list = []
        rays = trace_fields(lens, view, pupil, record)
        middle = len(view.wavelengths) // 2
        x, y, valid = rays.x[..., :-1], rays.y[..., :-1], rays.valid[..., :-1]
        chief_y = rays.y[:, middle, -1]
        arrived = valid * weight
        centroid_y = (y * arrived).sum((1, 2)) / arrived.sum((1, 2)).clamp(min=1e-12)
        centre = centroid_y if self.settings.reference == "centroid" else chief_y
        # From axis to corner the weight of a field goes geometrically from 1 to `corner_weight`.
        field = self.settings.corner_weight ** torch.tensor(_HEIGHTS, dtype=torch.float64)
        share = torch.sqrt(field[:, None, None] / field.sum() * weight / len(view.wavelengths))
        errors = [torch.where(valid, 1e3 * share * error, _LOST * share) for error in (x, y - centre[:, None, None])]
        semi_diameter = _RIM * torch.stack([torch.hypot(r.x, r.y).detach().max() for r in record])
        chief = torch.stack([rays.x[:, middle, -1], chief_y], -1)
        margins = manufacturing_margins(lens, self.limits, semi_diameter)
        margins |= first_order_margins(lens, self.limits, view, chief)
        operands = [_SHORTFALL * shortfall(margins)]
        if self.settings.max_chief_ray_angle_deg is not None:
            angle = torch.rad2deg(torch.atan2(rays.m[:, middle, -1].abs(), rays.n[:, middle, -1]))
            operands.append((angle - self.settings.max_chief_ray_angle_deg).clamp(min=0))
        # A kicked lens can leave every range; scipy wants numbers all the same, as bad as they may be.
        return torch.nan_to_num(torch.cat([error.flatten() for error in errors] + operands), 1e6, 1e6, -1e6)


def improve(
    lens: Lens,
    merit: Merit,
    names: Sequence[str],
    evaluations: int,
    watch: Callable[[float], None] = lambda error: None,
) -> tuple[Lens, float]:
    """Damped least squares over the variables `names`; returns the lens and its root-sum-square residual [um].

    `watch` is called with the root-sum-square residual at each evaluation.
    """
    variables = Variables.plain(lens)
    start = {name: value for name, value in variables.values().items() if name in names}
    sizes = [len(value) for value in start.values()]

    def residuals(vector: Tensor) -> Tensor:
        return merit.residuals(variables.assemble(dict(zip(start, vector.split(sizes), strict=True))))

    def watched(vector: numpy.ndarray) -> numpy.ndarray:
        errors = residuals(torch.from_numpy(vector)).numpy()
        watch(float(numpy.linalg.norm(errors)))
        return errors

    def with_value(vector: Tensor) -> tuple[Tensor, Tensor]:
        value = residuals(vector)
        return value, value

    jacobian_and_value = torch.func.jacfwd(with_value, has_aux=True)
    result = least_squares(
        watched,
        torch.cat(list(start.values())).numpy(),
        jac=lambda vector: jacobian_and_value(torch.from_numpy(vector))[0].numpy(),
        method="trf",
        x_scale="jac",
        max_nfev=evaluations,
    )
    vector = torch.from_numpy(result.x)
    return variables.assemble(dict(zip(start, vector.split(sizes), strict=True))), float((2 * result.cost) ** 0.5)


def random_starts(flat: Lens, view: View, limits: Constraints, count: int, rng: numpy.random.Generator) -> list[Lens]:
    """Random paraxial lenses of the right focal length and track, focused; the last curvature is solved for."""
    glass = list(flat.glass)
    middle = view.wavelengths[len(view.wavelengths) // 2]
    strongest = 0.9 * limits.max_slope / float(flat.semi_diameter[flat.stop])  # slope at the height of the stop
    found: list[Lens] = []
    while len(found) < count:
        curvature, thickness = flat.curvature.clone(), flat.thickness.clone()
        curvature[glass] = torch.from_numpy(rng.uniform(-strongest, strongest, len(glass)))
        curvature[glass[-1]] = 0
        for i in glass[:-1]:
            least = limits.min_centre_thickness if flat.media[i] != AIR else 2 * limits.min_air_gap
            thickness[i] = rng.uniform(least, _SPACES * view.efl)
        lens = replace(flat, curvature=curvature, thickness=thickness)
        without = paraxial(lens, middle).power
        unit = torch.zeros_like(curvature)
        unit[glass[-1]] = 1
        per_curvature = paraxial(replace(lens, curvature=curvature + unit), middle).power - without
        curvature = curvature + unit * (1 / view.efl - without) / per_curvature
        if curvature[glass[-1]].abs() > strongest:
            continue
        bfl = paraxial(replace(lens, curvature=curvature), middle).bfl
        thickness = torch.cat([thickness[:-1], bfl[None]])
        if bfl > limits.min_back_focus and thickness.sum() < limits.max_track:
            found.append(replace(lens, curvature=curvature, thickness=thickness))
    return found


def design(flat: Lens, view: View, limits: Constraints, settings: LeastSquares, seed: int, history: list[dict]) -> Lens:
    """The best lens found within the budget of `settings`; arguments as for `spot.design`."""
    rng = numpy.random.default_rng(seed)
    merit = Merit(view, limits, settings)
    orders = [f"alpha_{order}" for order in ORDERS if order <= settings.highest_order]
    stages = (("curvature", "thickness"), ("curvature", "thickness", *orders[:2]), ("curvature", "thickness", *orders))
    starts = random_starts(flat, view, limits, settings.starts, rng)
    candidates = sorted(((float(merit.residuals(lens).norm()), i, lens) for i, lens in enumerate(starts)))
    kept = max(1, settings.keep)
    progress = Progress("least squares", settings.evaluations + settings.kicks * _KICK_EVALUATIONS)
    evaluations = itertools.count(1)

    def watch(error: float) -> None:
        progress(next(evaluations), rms_um=error)

    for stage, names in enumerate(stages):
        each = max(2, settings.evaluations // (len(stages) * kept))
        improved = []
        for _, i, lens in candidates[:kept]:
            lens, error = improve(lens, merit, names, each, watch)
            improved.append((error, i, lens))
            history.append({"step": len(history) + 1, "stage": stage + 1, "rms_um": error})
        candidates = sorted(improved)
        kept = max(1, kept // 3)
    best, _, lens = candidates[0]
    for _ in range(settings.kicks):
        kicked, error = improve(_kick(lens, rng), merit, stages[-1], _KICK_EVALUATIONS, watch)
        if error < best:
            best, lens = error, kicked
        history.append({"step": len(history) + 1, "stage": len(stages) + 1, "rms_um": best})
    return lens


def _kick(lens: Lens, rng: numpy.random.Generator) -> Lens:
    """The lens with about 40 % of its variables moved by a few per cent of their scale."""
    variables = Variables.plain(lens)
    size = rng.uniform(0.015, 0.15)
    moved = {}
    for name, value in variables.values().items():
        chosen = rng.random(len(value)) < 0.4
        moved[name] = value + torch.from_numpy(chosen * rng.normal(0, size, len(value))) * value.abs().mean()
    return variables.assemble(moved)
