"""Imaging design by damped least squares: ray residuals, random starts, staged variables, basin hopping.

Many paraxial starts are improved in stages (curvatures and spaces, low orders, all orders), and each stage keeps fewer
of them. The survivors are repeatedly perturbed and improved, as in Hammer optimisation, and again only the best are
kept. Budgets count evaluations, so that the result does not depend on the speed of the machine.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy
import torch
from scipy.optimize import least_squares

from tasklens.design.merit import VIOLATION_UM_PER_MM, Merit
from tasklens.design.problem import History, Problem
from tasklens.design.start import random_starts
from tasklens.design.variables import ORDERS, Variables
from tasklens.optics.analysis.spots import heights_at, smallest_aperture, with_vignetting_aperture
from tasklens.optics.lens import Lens
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.devices import single_thread
from tasklens.runtime.progress import Progress
from tasklens.settings.least_squares_settings import LeastSquaresSettings

_STAGES = ((1.0, 0, 0.12), (0.27, 2, 0.06), (0.08, 4, 0.04))  # fraction of starts, asphere orders, fraction of budget
_PERTURBATIONS = ((0.05, 0.27), (0.02, 0.28), (0.0, 0.23))  # fraction of starts, at least one lens; fraction of budget
_PERTURBATION_EVALUATIONS = 12
_VIGNETTINGS = 4  # times that an aperture is set again, each followed by `_STRICT_EVALUATIONS`
_SHAPE = ("curvature", "thickness", "alpha")  # tensors of a lens that a design changes
_NEARLY_KEPT_UM = 50.0  # residual of limits at which a repair changes the lens little
_BISECTIONS = 30  # bisections of a step that ends below `spot_um`
_SEARCH_ANGLES = 0.06  # weight of chief ray angles in the search, 1 um/degree; with 1, doublets end 1.3 um worse
_STRICT_EVALUATIONS = 24
_STRICT = 20.0  # factor on the weight of limits at the end; from the start it would restrict the search


class _Enough(Exception):
    """The lens is as sharp as requested."""


def improve(
    lens: Lens,
    merit: Merit,
    names: Sequence[str],
    evaluations: int,
    watch: Callable[[float], None] = lambda error: None,
    enough_um: float = 0.0,
) -> tuple[Lens, float]:
    """Improve the variables `names` by damped least squares; return the lens and its root-sum-square residual [um].

    `watch` is called with the root-sum-square residual at each evaluation. The search stops as soon as the RMS spot
    radius is less than `enough_um` and limits are nearly kept. It then bisects the last step, and returns the lens with
    this spot radius, or `lens` if that is already sharper.
    """
    variables = Variables.plain(lens)
    start = {name: value for name, value in variables.values().items() if name in names}
    changes = variables.directions(start)
    latest: dict = {}  # scipy evaluates derivatives only at the vector of the latest residuals

    def assemble(vector: numpy.ndarray) -> Lens:
        return variables.assemble_vector(list(start), torch.from_numpy(vector))

    def residuals(vector: numpy.ndarray) -> numpy.ndarray:
        errors, columns = merit.linearise(assemble(vector))
        watch(float(errors.norm()))
        if enough_um and merit.spot_um(errors) < enough_um and float(errors[merit.rays :].norm()) < _NEARLY_KEPT_UM:
            latest["enough"] = vector.copy()
            raise _Enough
        latest.update(columns=columns, vector=vector.copy())
        return errors.numpy()

    def jacobian(vector: numpy.ndarray) -> numpy.ndarray:
        assert numpy.array_equal(vector, latest["vector"])
        return latest["columns"](changes).numpy()

    try:
        result = least_squares(
            residuals,
            torch.cat(list(start.values())).numpy(),
            jac=jacobian,
            method="trf",
            x_scale="jac",
            max_nfev=evaluations,
        )
    except _Enough:
        sharp, blurred = latest["enough"], latest.get("vector", latest["enough"])
        for _ in range(_BISECTIONS):
            middle = (sharp + blurred) / 2
            is_sharp = merit.spot_um(merit.residuals(assemble(middle))) < enough_um
            sharp, blurred = (middle, blurred) if is_sharp else (sharp, middle)
        return assemble(sharp), float(merit.residuals(assemble(sharp)).norm())
    return assemble(result.x), float((2 * result.cost) ** 0.5)


Candidate = tuple[float, int, Lens]  # root-sum-square residual [um], number of its start, lens


class _Search:
    """Improvement of candidates; each result is a part of the checkpoint."""

    def __init__(self, problem: Problem, settings: LeastSquaresSettings, checkpoint: Checkpoint):
        self.settings, self.checkpoint = settings, checkpoint
        self.rng = numpy.random.default_rng(problem.seed)
        limits = problem.limits
        angles = [limits.max_chief_ray_angle_deg, settings.max_chief_ray_angle_deg]
        angle = min((angle for angle in angles if angle is not None), default=None)
        limits = limits.model_copy(update={"max_chief_ray_angle_deg": angle})
        options = problem.view, limits, settings.reference, settings.corner_weight
        self.merit = Merit(*options, angle_weight=_SEARCH_ANGLES)
        self.strict = Merit(*options, per_mm=_STRICT * VIOLATION_UM_PER_MM)
        self.orders = [f"alpha_{order}" for order in ORDERS if order <= settings.highest_order]
        self.progress = Progress("least squares", settings.evaluations)
        self.evaluations = itertools.count(1)
        self.history: History = []
        self.enough_um = float(settings.spot_um or 0.0)  # type: ignore[arg-type]  # a number for one lens

    def improve(self, lens: Lens, merit: Merit, orders: int, evaluations: int) -> tuple[Lens, float]:
        """Improve curvatures, thicknesses and the first `orders` asphere orders, with progress lines."""
        names = ("curvature", "thickness", *self.orders[:orders])
        watch, limit_um = lambda e: self.progress(next(self.evaluations), rms_um=e), self.enough_um
        return improve(lens, merit, names, evaluations, watch, limit_um)

    def stage(self, orders: int, candidate: Candidate, budget: int) -> tuple[Lens, float]:
        """Improve a candidate in the first `orders` asphere orders."""
        return self.improve(candidate[2], self.merit, orders, max(2, budget))

    def hop(self, candidate: Candidate, budget: int) -> tuple[Lens, float]:
        """Improve a candidate by basin hopping: perturb and improve repeatedly, and keep better lenses."""
        best, _, lens = candidate
        for _ in range(max(1, budget // _PERTURBATION_EVALUATIONS)):
            perturbed = _perturb(lens, self.rng)
            trial, error = self.improve(perturbed, self.merit, _STAGES[-1][1], _PERTURBATION_EVALUATIONS)
            if error < best:
                best, lens = error, trial
        return lens, best

    def vignette(self, lens: Lens) -> tuple[Lens, float]:
        """Improve a lens with a clear aperture on each surface in turn; return the best, with its aperture."""
        merit, loss = self.strict, self.settings.vignetting
        assert loss is not None
        results = []
        for surface in lens.refracting_surfaces:
            clipped = lens
            for _ in range(_VIGNETTINGS):
                heights = heights_at(clipped, merit.view, merit.pupil, surface)
                inside = heights[..., : len(merit.weight)]
                merit.keep(inside <= smallest_aperture(inside, merit.weight, heights[0], loss))
                clipped, error = self.improve(clipped, merit, _STAGES[-1][1], _STRICT_EVALUATIONS)
            results.append((error, surface, clipped))
        error, surface, clipped = min(results, key=lambda result: result[:2])
        return with_vignetting_aperture(clipped, merit.view, surface, loss), error

    def best(
        self,
        name: str,
        candidates: list[Candidate],
        fraction: float,
        share: float,
        improve: Callable[[Candidate, int], tuple[Lens, float]],
    ) -> list[Candidate]:
        """Improve the best candidates with a share of the budget: a `fraction` of the starts, at least one."""
        survivors = sorted(candidates, key=lambda item: item[:2])[: max(1, round(fraction * self.settings.starts))]
        budget = round(share * self.settings.evaluations / len(survivors))
        return [self._resumable(name, candidate, partial(improve, candidate, budget)) for candidate in survivors]

    def _resumable(self, stage: str, candidate: Candidate, improve: Callable[[], tuple[Lens, float]]) -> Candidate:
        """Improve a candidate, or load the result from the checkpoint."""
        part = self.checkpoint.part(f"{stage}, start {candidate[1]}")
        if part.result is None:
            lens, error = improve()
            part.history.append({"stage": stage, "start": candidate[1], "rms_um": error})
            shape = {key: getattr(lens, key) for key in _SHAPE}
            part.finish(error=error, shape=shape, rng=self.rng.bit_generator.state)
        else:
            self.rng.bit_generator.state = part.result["rng"]
            error, lens = part.result["error"], replace(candidate[2], **part.result["shape"])
        self.history += part.history
        return error, candidate[1], lens


@single_thread()
def design(
    flat: Lens, problem: Problem, settings: LeastSquaresSettings, checkpoint: Checkpoint = NO_CHECKPOINT
) -> tuple[Lens, History]:
    """Return the best lens found within the budget of `settings`, and a row per candidate of each stage.

    Args:
        flat: flat plates with the materials, stop and stop distance of the lens.
    """
    search = _Search(problem, settings, checkpoint)
    starts = random_starts(flat, problem.view, problem.limits, settings.starts, search.rng)
    candidates: list[Candidate] = [(0.0, i, lens) for i, lens in enumerate(starts)]
    for fraction, orders, share in _STAGES:
        candidates = search.best(f"{orders} orders", candidates, fraction, share, partial(search.stage, orders))
        for _, _, lens in sorted(candidates, key=lambda candidate: candidate[:2]) if search.enough_um else ():
            if search.merit.spot_um(search.merit.residuals(lens)) <= search.enough_um:
                return lens, [{"step": step, **row} for step, row in enumerate(search.history, 1)]
    for k, (fraction, share) in enumerate(_PERTURBATIONS):
        candidates = search.best(f"perturbations {k + 1}", candidates, fraction, share, search.hop)
    _, start, lens = min(candidates, key=lambda candidate: candidate[:2])
    rows = search.history
    if settings.vignetting is not None:
        lens, error = search.vignette(lens)
        rows.append({"stage": "vignetting", "start": start, "rms_um": error})
    else:
        lens, error = search.improve(lens, search.strict, _STAGES[-1][1], _STRICT_EVALUATIONS)
        rows.append({"stage": "strict limits", "start": start, "rms_um": error})
    return lens, [{"step": step, **row} for step, row in enumerate(rows, 1)]


def _perturb(lens: Lens, rng: numpy.random.Generator) -> Lens:
    """Perturb about 40 % of the variables by 1.5 to 15 % of their mean magnitude (standard deviation)."""
    variables = Variables.plain(lens)
    size = rng.uniform(0.015, 0.15)
    values = {}
    for name, value in variables.values().items():
        mask = rng.random(len(value)) < 0.4
        values[name] = value + torch.from_numpy(mask * rng.normal(0, size, len(value))) * value.abs().mean()
    return variables.assemble(values)
