"""Task-driven design: ray-space descent on the loss of a frozen classifier, with restarts.

Gradient descent from flat plates ends in poor lenses, for two reasons: equal steps of the variables cause very
different ray displacements, and results depend strongly on the image order. So each step is measured in ray
displacement (see `ray_space`), and of several restarts from the plates the one with the smallest validation loss is
refined.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from tasklens.design.driver import Descent, History, Step, divergence, run
from tasklens.design.problem import Problem
from tasklens.design.ray_space import LinearModel, RaySpace
from tasklens.design.schedule import cosine, geometric
from tasklens.design.supervision import Supervisor, energy_in_window
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.lens import Lens
from tasklens.recognition.classifiers import frozen
from tasklens.recognition.training import Shuffled
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.study.design_settings import RaySpaceSettings, TaskDrivenSettings

_LEEWAY_MM = 0.05  # increase of the violation norm above which a step is halved
_HALVINGS = 5  # maximum number of halvings of a step
_SELECTION_IMAGES = 64  # images for the selection among restarts


class RaySpaceDescent(Descent):
    """Descent on a frozen classifier's loss with steps of given ray displacement.

    Args:
        start: starting lens.
        supervisor: supervisor with the frozen classifier.
        task: numbers of rays and images per step.
        settings: settings of the descent.
        seed: seed of the rays and of the image order.
    """

    def __init__(
        self, start: Lens, supervisor: Supervisor, task: TaskDrivenSettings, settings: RaySpaceSettings, seed: int
    ):
        problem = supervisor.problem
        self.supervisor, self.task, self.settings, self.seed = supervisor, task, settings, seed
        self.steps = settings.steps
        self.space = RaySpace(start, problem.view, problem.limits)
        self.vector = self.finite = self.space.start
        self.mean = torch.zeros_like(self.vector)
        self.model = self.space.linearise(self.vector)
        self.order = Shuffled(len(supervisor.dataset), task.batch_size, torch.Generator().manual_seed(seed))
        self.holders = {"order": self.order}

    def step(self, step: int) -> Step:
        """Take a step along the mean gradient, with the step size and pixel pitch of this step."""
        settings, view = self.settings, self.supervisor.problem.view
        indices = self.order.next()
        pixels, step_um = self._schedule((step - 1) / self.steps)
        leaf = self.vector.clone().requires_grad_()
        lens = self.space.lens(leaf)
        pupil = sobol_disc(self.task.rays, self.seed + step)
        rays, grid = self.supervisor.trace(lens, pupil, pixels)
        losses, gradient = self.supervisor.loss(indices, grid)
        (slope,) = torch.autograd.grad(grid, leaf, gradient)
        self.mean = settings.momentum * self.mean + (1 - settings.momentum) * slope
        change = self.model.step(self.mean / (1 - settings.momentum**step), step_um, settings.damping)
        if not (torch.isfinite(losses).all() and torch.isfinite(change).all()):
            self.vector = self.finite
            raise divergence(lens, view, pupil, losses)
        numbers = {
            "loss": losses.mean().item(),
            "worst_field": losses.max().item(),
            "energy_in_window": energy_in_window(grid),
            "pixel_scale": pixels,
            "step_size_um": step_um,
            "violation": self.model.violation_norm,
        }
        self.finite = self.vector
        self.vector, self.model = self._advance(change)
        return Step(rays, losses, numbers)

    def _schedule(self, done: float) -> tuple[float, float]:
        """Return pixel pitch [sensor pixels] and step size [um] after a fraction `done` of the steps."""
        settings = self.settings
        first, last = settings.pixels
        pixels = last * geometric(first / last, done / settings.duration)
        step_um = settings.step_size * self.supervisor.problem.view.pixel_pitch * pixels
        if done > settings.duration:
            step_um *= cosine((done - settings.duration) / (1 - settings.duration), settings.final)
        return pixels, step_um

    def _advance(self, change: Tensor) -> tuple[Tensor, LinearModel]:
        """Return the variables after `change`, and their model; the change is halved while it adds much violation."""
        for halvings in range(_HALVINGS + 1):
            moved = self.vector + change / 2**halvings
            model = self.space.linearise(moved)
            if model.violation_norm <= self.model.violation_norm + _LEEWAY_MM:
                break
        return moved, model

    def state(self) -> dict[str, Any]:
        """Return the variables, the mean gradient, and the last variables with a finite loss."""
        return {"vector": self.vector, "mean": self.mean, "finite": self.finite}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Resume from `state`, and linearise again."""
        self.vector, self.mean, self.finite = (state[name] for name in ("vector", "mean", "finite"))
        self.model = self.space.linearise(self.vector)

    def lens(self) -> Lens:
        """Return the present lens."""
        return self.space.lens(self.vector)


def design(
    start: Lens,
    classifier: nn.Module,
    problem: Problem,
    settings: TaskDrivenSettings,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> tuple[Lens, History]:
    """Return the refined best restart from `start`, and the history of all; the classifier is not changed."""
    classifier = frozen(classifier, settings.batch_norm)
    supervisor = Supervisor(classifier, problem, settings.size, settings.augment, settings.micro_batch)
    torch.manual_seed(problem.seed)  # TrivialAugment uses torch's global generator
    generator = torch.Generator().manual_seed(problem.seed)
    selection = torch.randperm(len(supervisor.dataset), generator=generator)[:_SELECTION_IMAGES]
    seeds = [int(torch.randint(2**31, (), generator=generator)) for _ in range(settings.restarts + 1)]
    pupil, pixels = sobol_disc(settings.rays, problem.seed), settings.restart.pixels[1]
    history: History = []
    found = []
    for k, seed in enumerate(seeds[:-1]):
        label = f"restart {k + 1} of {settings.restarts}"
        lens, rows = run(RaySpaceDescent(start, supervisor, settings, settings.restart, seed), label, checkpoint)
        loss = supervisor.validation_loss(lens, selection, pupil, pixels)
        history += [*rows, {"phase": f"{label}, selection", "step": settings.restart.steps, "loss": loss}]
        found.append((loss, k, lens))
    best = min(found, key=lambda entry: entry[:2])[2]
    refinement = RaySpaceDescent(best, supervisor, settings, settings.refinement, seeds[-1])
    lens, rows = run(refinement, "refinement", checkpoint)
    return lens, history + rows
