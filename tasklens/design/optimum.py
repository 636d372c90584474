"""Test whether a finished lens is a local optimum of its criterion within its limits."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tasklens.design.ray_space import HARD, RaySpace, repair
from tasklens.design.supervision import SELECTION, Supervisor
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.lens import Lens
from tasklens.study.design_settings import DescentSettings

STEP_UM = 0.5  # RMS ray displacement of the steps that are tried
_DIRECTIONS = 4  # random ones
_RAYS = 512  # per field and colour, of the gradient
_MICRO_STEP = 16  # images per gradient


def local_optimum(lens: Lens, supervisor: Supervisor, settings: DescentSettings) -> dict[str, Any]:
    """Try feasible steps of small ray displacement from a lens: along its gradient, and in random directions.

    The gradient is that of half of the images by which lenses are chosen, projected on the limits in ray space. Every
    step is repaired, so that it is feasible, and its loss is compared on the other half, image by image.

    Args:
        supervisor: criterion of its last descent; a trained network is as at its end.

    Returns:
        The step [um], the number of images, the largest `gain` of the steps: the mean decrease of the loss; its
        standard `error`, paired by image; and `along` which direction it was. No step may gain more than a lens that
        is no optimum: the gain is negative if all steps are worse.
    """
    problem, pixels = supervisor.problem, settings.pixels[1]
    space = RaySpace(lens, problem.view, problem.limits)
    model = space.linearise(space.start)
    generator = torch.Generator().manual_seed(problem.seed)
    directions = {"gradient": _gradient(space, supervisor, pixels)}
    for k in range(_DIRECTIONS):
        drawn = model.scale * torch.randn(len(model.scale), generator=generator, dtype=model.scale.dtype)
        directions[f"random direction {k + 1}"] = model.metric @ drawn
    here = _losses(supervisor, lens, pixels)
    gains = {}
    for name, gradient in directions.items():
        change = model.step(gradient, STEP_UM, settings.damping, HARD)
        moved, _ = repair(space.lens(space.start + change), problem.view, problem.limits)
        difference = here - _losses(supervisor, moved, pixels)
        gains[name] = float(difference.mean()), float(difference.std() / len(difference) ** 0.5)
    along = max(gains, key=lambda name: gains[name])
    gain, error = gains[along]
    return {"step_um": STEP_UM, "gain": gain, "error": error, "along": along, "images": len(here)}


def _halves(supervisor: Supervisor) -> tuple[slice, slice]:
    """Return the parts of the images in fixed order for gradient and comparison; alike where there are few."""
    count = len(supervisor.dataset)
    first = max(0, count + SELECTION.start)
    middle = (first + count) // 2
    return slice(first, middle), slice(middle, count)


def _losses(supervisor: Supervisor, lens: Lens, pixels: float) -> Tensor:
    return supervisor.fixed_losses(lens, pixels, _halves(supervisor)[1]).double()


def _gradient(space: RaySpace, supervisor: Supervisor, pixels: float) -> Tensor:
    """Compute the gradient (V,) of the mean loss on the fixed images, by micro-steps of some images."""
    supervisor = replace(supervisor, augment=False)
    indices = supervisor.fixed_images(_halves(supervisor)[0])
    total = torch.zeros_like(space.start)
    with supervisor.criterion.evaluating():
        for k, some in enumerate(indices.split(_MICRO_STEP)):
            vector = space.start.clone().requires_grad_()
            loss = supervisor.loss(space.lens(vector), sobol_disc(_RAYS, seed=0), pixels, some, k)
            (gradient,) = torch.autograd.grad(loss.value, vector)
            total += gradient * len(some) / len(indices)
    return total
