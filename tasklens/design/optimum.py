"""Test whether a finished lens is a local optimum of its criterion within its limits."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tasklens.design.objective import SELECTION_IMAGES, Objective
from tasklens.design.ray_space import HARD, RaySpace, repair
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.lens import Lens
from tasklens.settings.design_settings import DescentSettings

# RMS ray displacements of steps along the gradient. Random steps use the first; it hardly affects a blurred lens.
STEPS_UM = (0.5, 2.0, 8.0)
_DIRECTIONS = 4  # random directions
_RAYS = 512  # rays per field and colour for the gradient
_MICRO_STEP = 16  # images per gradient
_LENSES = 8  # built lenses per gradient without images, if the design has a tolerance grade
_SEED = 7001  # added to the seed: other built lenses than those of the design and of the report


def local_optimum(lens: Lens, objective: Objective, settings: DescentSettings) -> dict[str, Any]:
    """Try feasible steps of small ray displacement from a lens: along its gradient, and in random directions.

    For captures, the gradient is that of half of the selection images. It is projected on the limits in ray space.
    Every step is repaired, so that it is feasible, and its loss is compared on the other half, image by image.

    Args:
        objective: that of the last descent; a trained network has its final state.

    Returns:
        The largest `gain` of the steps (mean decrease of the loss, negative if all steps increase it); its standard
        `error`, paired by image; its `step_um` and its direction `along`; the number of `images`. A loss of rays or
        PSFs has no images, and no error.
    """
    problem, pixels = objective.problem, settings.pixels[1]
    space = RaySpace(lens, problem.view, problem.limits, problem.free)
    model = space.linearise(space.start)
    generator = torch.Generator().manual_seed(problem.seed)
    gradient = _gradient(space, objective, pixels)
    steps = [("gradient", step_um, gradient) for step_um in STEPS_UM]
    for k in range(_DIRECTIONS):
        sample = model.scale * torch.randn(len(model.scale), generator=generator, dtype=model.scale.dtype)
        steps.append((f"random direction {k + 1}", STEPS_UM[0], model.metric @ sample))
    losses, captured = _losses(objective, lens, pixels), objective.criterion.reads_images
    gains: list[dict[str, Any]] = []
    for direction, step_um, slope in steps:
        change = model.step(slope, step_um, settings.damping, HARD)
        trial, _ = repair(space.lens(space.start + change), problem.view, problem.limits, problem.free)
        difference = losses - _losses(objective, trial, pixels)
        error = float(difference.std() / len(difference) ** 0.5) if captured else 0.0
        gains.append({"gain": float(difference.mean()), "error": error, "step_um": step_um, "along": direction})
    return max(gains, key=lambda step: step["gain"]) | {"images": len(losses) if captured else 0}


def _halves(objective: Objective) -> tuple[slice, slice]:
    """Return two halves of the selection images, all images if there are few; none for a design without images."""
    if objective.problem.dataset is None:
        return slice(0), slice(0)
    count = len(objective.dataset)
    first = max(0, count + SELECTION_IMAGES.start)
    middle = (first + count) // 2
    return slice(first, middle), slice(middle, count)


def _losses(objective: Objective, lens: Lens, pixels: float) -> Tensor:
    return objective.fixed_losses(lens, pixels, _halves(objective)[1]).double()


def _gradient(space: RaySpace, objective: Objective, pixels: float) -> Tensor:
    """Compute the gradient (V,) of the mean loss, in batches of a few images; each has a built lens of its own."""
    objective = replace(objective, augment=False)
    batches: Sequence[Tensor | None] = [None] * (1 if objective.grade is None else _LENSES)
    if objective.problem.dataset is not None:
        batches = objective.fixed_images(_halves(objective)[0]).split(_MICRO_STEP)
    weights = [1 if batch is None else len(batch) for batch in batches]
    total = torch.zeros_like(space.start)
    with objective.criterion.evaluating():
        for k, (batch, weight) in enumerate(zip(batches, weights, strict=True)):
            vector = space.start.clone().requires_grad_()
            lens = space.lens(vector)
            (built_lens,) = objective.as_built(lens, objective.problem.seed + _SEED + k)
            loss = objective.loss(built_lens, sobol_disc(_RAYS, seed=0), pixels, batch, k, lens)
            (gradient,) = torch.autograd.grad(loss.value, vector)
            total += gradient * weight / sum(weights)
    return total
