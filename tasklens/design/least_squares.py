"""Imaging design by damped least squares: ray residuals, random starts, staged variables, basin hopping.

The way of a lens designer: many paraxial starts are improved in stages (curvatures and spaces, low orders, all orders),
and fewer of them are kept each time. Those left are perturbed out of their minima again and again, as in Hammer
optimisation, and again only the best are kept. Budgets count evaluations, so that the result does not depend on the machine.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy
import torch
from scipy.optimize import least_squares

from tasklens.design.merit import VIOLATION, Merit
from tasklens.design.start import ORDERS, Variables
from tasklens.materials.material import AIR
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.progress import Progress
from tasklens.study.design_settings import LeastSquaresSettings
from tasklens.study.settings import Constraints

_SPACES = 0.35  # a random start draws its element and air thicknesses below this part of the focal length
_STAGES = ((1.0, 0, 0.12), (0.27, 2, 0.06), (0.08, 4, 0.04))  # part of the starts, asphere orders, part of the budget
_PERTURBATIONS = ((0.05, 0.27), (0.02, 0.28), (0.0, 0.23))  # part of the starts, at least one lens; part of the budget
_PERTURBATION_EVALUATIONS = 12
_SHAPE = ("curvature", "thickness", "alpha")  # of a lens: what a design changes
_STRICT = 20.0  # times the weight of limits at the end: from the start it would hem in the search


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
    changes = variables.directions(start)
    latest: dict = {}  # scipy asks for derivatives only at the last vector that it asked residuals for

    def assembled(vector: numpy.ndarray) -> Lens:
        return variables.assemble_vector(list(start), torch.from_numpy(vector))

    def residuals(vector: numpy.ndarray) -> numpy.ndarray:
        errors, latest["columns"] = merit.linearise(assembled(vector))
        latest["vector"] = vector.copy()
        watch(float(errors.norm()))
        return errors.numpy()

    def jacobian(vector: numpy.ndarray) -> numpy.ndarray:
        assert numpy.array_equal(vector, latest["vector"])
        return latest["columns"](changes).numpy()

    result = least_squares(
        residuals,
        torch.cat(list(start.values())).numpy(),
        jac=jacobian,
        method="trf",
        x_scale="jac",
        max_nfev=evaluations,
    )
    return assembled(result.x), float((2 * result.cost) ** 0.5)


def random_starts(flat: Lens, view: View, limits: Constraints, count: int, rng: numpy.random.Generator) -> list[Lens]:
    """Random paraxial lenses of the right focal length and track, focused; the last curvature is solved for."""
    glass = list(flat.refracting_surfaces)
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


def design(
    flat: Lens,
    view: View,
    limits: Constraints,
    settings: LeastSquaresSettings,
    seed: int,
    history: list[dict],
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> Lens:
    """The best lens found within the budget of `settings`; arguments as for `spot.design`, a part per candidate."""
    rng = numpy.random.default_rng(seed)
    habits = settings.reference, settings.corner_weight, settings.max_chief_ray_angle_deg
    merit = Merit(view, limits, *habits)
    orders = [f"alpha_{order}" for order in ORDERS if order <= settings.highest_order]
    progress = Progress("least squares", settings.evaluations)
    evaluations = itertools.count(1)

    def watch(error: float) -> None:
        progress(next(evaluations), rms_um=error)

    def log(stage: str, error: float) -> None:
        history.append({"step": len(history) + 1, "stage": stage, "rms_um": error})

    def onward(candidates: list, part: float, share: float) -> tuple[list, int]:
        """The best candidates, and how many evaluations each of them may take."""
        kept = sorted(candidates)[: max(1, round(part * settings.starts))]
        return kept, round(share * settings.evaluations / len(kept))

    def remembered(name: str, search: Callable[[], tuple[float, Lens]]) -> tuple[float, Lens]:
        """Error and lens that `search` finds, or found before the job was killed."""
        part = checkpoint.part(name, history)
        if part.result is None:
            error, lens = search()
            shape = {key: getattr(lens, key) for key in _SHAPE}
            part.finish(error=error, shape=shape, rng=rng.bit_generator.state)
            return error, lens
        rng.bit_generator.state = part.result["rng"]
        return part.result["error"], replace(flat, **part.result["shape"])

    def staged(lens: Lens, count: int, budget: int) -> tuple[float, Lens]:
        lens, error = improve(lens, merit, ("curvature", "thickness", *orders[:count]), max(2, budget), watch)
        log(f"{count} orders", error)
        return error, lens

    def kicked(lens: Lens, best: float, baselines: int, budget: int) -> tuple[float, Lens]:
        for _ in range(max(1, budget // _PERTURBATION_EVALUATIONS)):
            other, error = improve(_perturbed(lens, rng), merit, names, _PERTURBATION_EVALUATIONS, watch)
            if error < best:
                best, lens = error, other
            log(f"perturbations of {baselines}", best)
        return best, lens

    candidates = [(0.0, i, lens) for i, lens in enumerate(random_starts(flat, view, limits, settings.starts, rng))]
    for stage, (share_kept, count, share) in enumerate(_STAGES):
        kept, budget = onward(candidates, share_kept, share)
        candidates = []
        for _, i, lens in kept:
            error, lens = remembered(f"stage {stage}, start {i}", partial(staged, lens, count, budget))
            candidates.append((error, i, lens))
    names = ("curvature", "thickness", *orders[: _STAGES[-1][1]])
    for stage, (share_kept, share) in enumerate(_PERTURBATIONS):
        kept, budget = onward(candidates, share_kept, share)
        candidates = []
        for error, i, lens in kept:
            error, lens = remembered(
                f"perturbations {stage}, start {i}", partial(kicked, lens, error, len(kept), budget)
            )
            candidates.append((error, i, lens))
    strict = Merit(view, limits, *habits, per_mm=_STRICT * VIOLATION)
    lens, error = improve(min(candidates)[2], strict, names, 2 * _PERTURBATION_EVALUATIONS, watch)
    log("strict limits", error)
    return lens


def _perturbed(lens: Lens, rng: numpy.random.Generator) -> Lens:
    """The lens with about 40 % of its variables moved by a few per cent of their scale."""
    variables = Variables.plain(lens)
    size = rng.uniform(0.015, 0.15)
    moved = {}
    for name, value in variables.values().items():
        chosen = rng.random(len(value)) < 0.4
        moved[name] = value + torch.from_numpy(chosen * rng.normal(0, size, len(value))) * value.abs().mean()
    return variables.assemble(moved)
