"""End-to-end design: joint gradient descent of lens and classifier on the classifier's loss, or of the lens alone."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from tasklens.design.criteria import CaptureCriterion, JointTaskLoss, TaskLoss
from tasklens.design.driver import History, Step, divergence, run
from tasklens.design.gradient_descent import GradientDescent
from tasklens.design.problem import Problem
from tasklens.design.schedule import geometric
from tasklens.design.supervision import LEEWAY_MM, VALIDATIONS, Supervisor, energy_in_window
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.lens import Lens
from tasklens.recognition.training import Shuffled
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.study.design_settings import JointDescentSettings


class JointDescent(GradientDescent):
    """Joint gradient descent of lens and network on the classifier's loss, with AdamW.

    The network is trained in place, in `train()`, with all captures of a step in one batch for its batch norms; a
    frozen one stays in `eval()`. The result is the lens of the smallest validation loss with the sensor's pixels and
    the full stop, and one far outside its limits only if all are; each validation compares the best lens with the
    present one by the network of that step. Before the first validation it is the last lens with a finite loss.
    """

    def __init__(self, start: Lens, classifier: nn.Module, problem: Problem, settings: JointDescentSettings):
        rate = settings.network_learning_rate
        criterion: CaptureCriterion
        if rate is None:
            criterion = TaskLoss(classifier.eval().requires_grad_(False))
        else:
            criterion = JointTaskLoss(classifier, rate, settings.steps, settings.learning_rates.final)
        captures = settings.batch_size * len(problem.view.fields)
        self.supervisor = Supervisor(criterion, problem, settings.size, settings.augment, captures)
        generator = torch.Generator().manual_seed(problem.seed)
        self.order = Shuffled(len(self.supervisor.dataset), settings.batch_size, generator)
        super().__init__(start, problem, settings.steps, settings.learning_rates, order=self.order, **criterion.holders)
        self.settings = settings
        self.least = True, math.inf  # whether the best lens is far outside its limits, and its validation loss

    def step(self, step: int) -> Step:
        """Take a step of AdamW on the loss of a batch, with the pixel pitch and stop of this step."""
        cold, view = self.settings.cold_start, self.problem.view
        indices = self.order.next()
        pixels = stop = 1.0
        if cold is not None:
            pixels = geometric(cold.pixel_scale, (step - 1) / (cold.pixel_duration * self.steps))
            stop = geometric(cold.stop_scale, (step - 1) / (cold.stop_duration * self.steps))
        numbers: dict[str, float] = {}
        if pixels == stop == 1 and (step - 1) % max(1, self.steps // VALIDATIONS) == 0:
            numbers["validation_loss"] = self._validate()
        lens = self.assemble()
        seed = self.problem.seed * self.steps + step
        pupil = sobol_disc(self.settings.rays, seed)
        stopped = lens.with_stop_scaled(stop)
        rays, grid = self.supervisor.trace(stopped, pupil, pixels)
        bounds = self.penalty(lens)
        losses, gradient = self.supervisor.loss(indices, grid, stopped, seed)
        if not torch.isfinite(losses.mean() + bounds):
            raise divergence(stopped, view, pupil, losses)
        if math.isinf(self.least[1]):
            self.remember()
        torch.autograd.backward([grid, self.settings.penalty * bounds], [gradient, None])
        self.advance()
        self.supervisor.criterion.train()
        numbers |= {
            "loss": losses.mean().item(),
            "penalty": bounds.item(),
            "energy_in_window": energy_in_window(grid),
            "pixel_scale": pixels,
            "stop_scale": stop,
            "learning_rate": self.learning_rate,
        }
        if step == self.steps:
            numbers["validation_loss"] = self._validate()
        return Step(rays, numbers)

    def _validate(self) -> float:
        """Compute the loss of the present lens and network on fixed images, and remember the lens if it is the best."""
        lens = self.assemble()
        loss = self.supervisor.validation_loss(lens, pixels=1.0)
        if self.supervisor.criterion.trained and math.isfinite(self.least[1]):
            self.least = self.least[0], self.supervisor.validation_loss(self.lens(), pixels=1.0)
        penalty = self.penalty(lens).item()
        found = penalty > LEEWAY_MM**2, loss
        if math.isfinite(loss + penalty) and found < self.least:  # a lens of NaN has grey captures
            self.least = found
            self.remember()
        return loss

    def state(self) -> dict[str, Any]:
        """Return the state of the gradient descent, and the smallest validation loss."""
        return super().state() | {"least": self.least}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Resume from `state`."""
        super().resume(state)
        self.least = state["least"]


def design(
    start: Lens,
    classifier: nn.Module,
    problem: Problem,
    settings: JointDescentSettings,
    label: str,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> tuple[Lens, History]:
    """Run a joint descent from `start`; return the lens and its history, and leave the classifier in `eval()`.

    Args:
        label: label of progress lines, history and the part of the checkpoint.
    """
    torch.manual_seed(problem.seed)  # TrivialAugment uses torch's global generator
    found = run(JointDescent(start, classifier, problem, settings), label, checkpoint)
    classifier.eval().requires_grad_(False)
    return found
