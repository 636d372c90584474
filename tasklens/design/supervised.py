"""Supervised design: ray-space descent on the loss of captures, with restarts, by a classifier or by the image error.

Gradient descent from flat plates ends in poor lenses, for two reasons: equal steps of the variables cause very
different ray displacements, and results depend strongly on the image order. So each step is measured in ray
displacement (see `ray_space`), and of several restarts from the plates the one with the smallest validation loss is
refined. It competes with imaging lenses, if there are any, for a last descent, the finish. Losses of a few images say
little about a lens: each descent ends with the lens of the smallest loss on a fixed set of images. Candidates are
judged by other images than those, and so is the finished lens, with its limits repaired: one that has only learned the
images of its descent, or loses by the repair what it had won, gives way to the candidate.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from tasklens.design.apertures import with_clear_apertures
from tasklens.design.criteria import CaptureCriterion, Contrast
from tasklens.design.driver import Descent, History, Step, divergence, run
from tasklens.design.problem import Problem
from tasklens.design.ray_space import HARD, SOFT, LinearModel, RaySpace, repair
from tasklens.design.schedule import cosine, geometric
from tasklens.design.supervision import LEEWAY_MM, VALIDATIONS, Supervisor, energy_in_window
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.lens import Lens
from tasklens.recognition.training import Shuffled
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.study.design_settings import RaySpaceSettings, SupervisedSettings

_STATE = ("vector", "mean", "averaged", "factor", "failures", "best", "least")
_PATIENCE = 3  # validations without a better lens
_HALVINGS = 5  # maximum number of halvings of a step

# Makers of the criterion of a descent, by the name it is given.
Criteria = Mapping[str, Callable[[RaySpaceSettings], CaptureCriterion | Contrast]]


class RaySpaceDescent(Descent):
    """Descent on the loss of captures with steps of given ray displacement.

    Its result is the lens of the smallest validation loss, taken at the last pixel pitch; where the criterion is
    trained, each validation compares the best lens with the present one by the network of that step. After a few
    validations without a better lens the descent goes back to the best, with half the step size: how large a step may
    be depends on how sharp the lens is.

    Args:
        start: starting lens.
        supervisor: supervisor of the lens.
        design: numbers of rays and images per step.
        settings: settings of the descent.
        seed: seed of the rays and of the image order.
    """

    def __init__(
        self,
        start: Lens,
        supervisor: Supervisor,
        design: SupervisedSettings,
        settings: RaySpaceSettings,
        seed: int,
    ):
        problem = supervisor.problem
        self.supervisor, self.design, self.settings, self.seed = supervisor, design, settings, seed
        self.steps = settings.steps
        self.space = RaySpace(start, problem.view, problem.limits)
        self.vector = self.best = self.space.start
        self.least = True, math.inf  # whether the best lens is far outside its limits, and its validation loss
        self.mean = torch.zeros_like(self.vector)
        self.averaged = 0  # steps in the mean gradient
        self.factor = 1.0  # on the step size
        self.failures = 0  # validations since the best lens
        self.model = self.space.linearise(self.vector)
        self.order = Shuffled(len(supervisor.dataset), design.batch_size, torch.Generator().manual_seed(seed))
        self.holders = {"order": self.order, **supervisor.criterion.holders}

    def step(self, step: int) -> Step:
        """Take a step along the mean gradient, with the step size and pixel pitch of this step."""
        settings, view = self.settings, self.supervisor.problem.view
        indices = self.order.next()
        numbers: dict[str, float] = {}
        pixels, step_um = self._schedule((step - 1) / self.steps)
        last = pixels == settings.pixels[1]
        if last and (step - 1) % max(1, self.steps // VALIDATIONS) == 0:
            numbers["validation_loss"] = self._validate()
            pixels, step_um = self._schedule((step - 1) / self.steps)
        leaf = self.vector.clone().requires_grad_()
        design = self.space.lens(leaf)
        (lens,) = self.supervisor.as_built(design, self.seed + step)
        pupil = sobol_disc(self.design.rays, self.seed + step)
        rays, grid = self.supervisor.trace(lens, pupil, pixels)
        losses, gradient = self.supervisor.loss(indices, grid, design, self.seed + step)
        (slope,) = torch.autograd.grad(grid, leaf, gradient)
        self.mean = settings.momentum * self.mean + (1 - settings.momentum) * slope
        self.averaged += 1
        # A repair of what is left at the end would cost more than the last steps have won.
        weight = HARD if last else SOFT
        change = self.model.step(self.mean / (1 - settings.momentum**self.averaged), step_um, settings.damping, weight)
        if not (torch.isfinite(losses).all() and torch.isfinite(change).all()):
            raise divergence(lens, view, pupil, losses)
        self.supervisor.criterion.train()
        numbers |= {
            "loss": losses.mean().item(),
            "worst_field": losses.max().item(),
            "energy_in_window": energy_in_window(grid),
            "pixel_scale": pixels,
            "step_size_um": step_um,
            "violation": self.model.violation_norm,
        }
        if math.isinf(self.least[1]):  # before the first validation the last finite lens is the best known
            self.best = self.vector
        self.vector, self.model = self._advance(change)
        if step == self.steps:
            numbers["validation_loss"] = self._validate()
        return Step(rays, numbers)

    def _validate(self) -> float:
        """Compute the loss of the present lens on the fixed images, and remember the lens if it is the best.

        A lens far outside its limits is not the best: its repair would make another one of it.
        """
        loss = self._validation_loss(self.vector)
        if self.supervisor.criterion.trained and math.isfinite(self.least[1]):
            self.least = self.least[0], self._validation_loss(self.best)
        found = self.model.violation_norm > LEEWAY_MM, loss
        if math.isfinite(loss) and found <= self.least:
            self.least, self.best, self.failures = found, self.vector, 0
            return loss
        self.failures += 1
        if self.failures == _PATIENCE:
            self.failures = 0
            self.vector, self.model, self.factor = self.best, self.space.linearise(self.best), self.factor / 2
            self.mean, self.averaged = torch.zeros_like(self.mean), 0
        return loss

    def _validation_loss(self, vector: Tensor) -> float:
        return self.supervisor.validation_loss(self.space.lens(vector), self.settings.pixels[1])

    def _schedule(self, done: float) -> tuple[float, float]:
        """Return pixel pitch [sensor pixels] and step size [um] after a fraction `done` of the steps."""
        settings = self.settings
        first, last = settings.pixels
        pixels = last * geometric(first / last, done / settings.duration)
        step_um = self.factor * settings.step_size * self.supervisor.problem.view.pixel_pitch * pixels
        if done > settings.duration:
            step_um *= cosine((done - settings.duration) / (1 - settings.duration), settings.final)
        return pixels, step_um

    def _advance(self, change: Tensor) -> tuple[Tensor, LinearModel]:
        """Return the variables after `change`, and their model; the change is halved while it adds much violation."""
        for halvings in range(_HALVINGS + 1):
            moved = self.vector + change / 2**halvings
            model = self.space.linearise(moved)
            if model.violation_norm <= self.model.violation_norm + LEEWAY_MM:
                break
        return moved, model

    def state(self) -> dict[str, Any]:
        """Return the variables, the mean gradient, the step size, and the best variables with their loss."""
        return {name: getattr(self, name) for name in _STATE}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Resume from `state`, and linearise again."""
        for name in _STATE:
            setattr(self, name, state[name])
        self.model = self.space.linearise(self.vector)

    def lens(self) -> Lens:
        """Return the lens of the smallest validation loss; before the first validation, the last finite one."""
        return self.space.lens(self.best)


def design(
    start: Lens,
    candidates: Mapping[str, Lens],
    criteria: Criteria,
    problem: Problem,
    settings: SupervisedSettings,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> tuple[Lens, dict[str, Any], History]:
    """Refine the best restart from `start`, and finish it, or a candidate of a smaller loss.

    Args:
        candidates: lenses by name.
        criteria: makers of criteria by the names that descents call them; one is made for each descent.

    Returns:
        The lens: the finished one, or a candidate that is better by a criterion that is not trained jointly. What its
        file says of its origin: its loss, those of all candidates on the same images, the candidate that it was
        finished from as `start`, and whether it is the `finished` one. And the history of all descents.
    """
    torch.manual_seed(problem.seed)  # TrivialAugment uses torch's global generator
    generator = torch.Generator().manual_seed(problem.seed)
    history: History = []

    def supervisor(part: RaySpaceSettings) -> Supervisor:
        criterion = criteria[part.criterion](part)
        size, centre = part.size, part.centre
        return Supervisor(criterion, problem, size, settings.augment, settings.micro_batch, centre, settings.tolerances)

    def descend(lens: Lens, part: RaySpaceSettings, label: str) -> tuple[tuple[bool, float], Lens]:
        seed = int(torch.randint(2**31, (), generator=generator))
        descent = RaySpaceDescent(lens, supervisor(part), settings, part, seed)
        found, rows = run(descent, label, checkpoint)
        history.extend(rows)
        return descent.least, found

    competing = dict(candidates)
    if settings.restart is not None and settings.refinement is not None:
        labels = [f"restart {k + 1} of {settings.restarts}" for k in range(settings.restarts)]
        restarts = [descend(start, settings.restart, label) for label in labels]
        (_, least), lens = descend(min(restarts, key=lambda found: found[0])[1], settings.refinement, "refinement")
        if settings.finish is None:
            return lens, {"validation_loss": least}, history
        competing["refinement"] = lens
    assert settings.finish is not None  # candidates have one
    finisher, pixels = supervisor(settings.finish), settings.finish.pixels[1]

    def selection_loss(lens: Lens) -> float:
        # As its file will have it: a repair of limits between the heights of the merit moves rays, apertures stop some.
        made = with_clear_apertures(*repair(lens, problem.view, problem.limits))
        return finisher.selection_loss(made, pixels)

    losses = {name: selection_loss(each) for name, each in competing.items() if candidates}
    history += [{"phase": f"candidate {name}", "validation_loss": loss} for name, loss in losses.items()]
    chosen = min(competing, key=lambda name: losses.get(name, 0.0))
    (_, least), lens = descend(competing[chosen], settings.finish, "finish")
    origin: dict[str, Any] = {"start": chosen} if chosen in candidates else {}
    origin["finished"] = True
    if candidates and not finisher.criterion.trained:
        least = selection_loss(lens)
        history.append({"phase": "finished", "validation_loss": least})
        if least > losses[chosen]:
            lens, least, origin["finished"] = competing[chosen], losses[chosen], False
    return lens, origin | {"validation_loss": least, "candidate_losses": losses}, history
