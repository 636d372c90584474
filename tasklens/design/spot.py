"""Imaging design by gradient descent on the RMS spot radius, with an opening stop."""

import math
from collections.abc import Mapping
from typing import Any

import torch

from tasklens.design.driver import History, Step, divergence, run
from tasklens.design.gradient_descent import GradientDescent
from tasklens.design.problem import Problem
from tasklens.design.schedule import geometric
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, trace_fields
from tasklens.optics.lens import Lens
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.study.design_settings import SpotSettings


class SpotDescent(GradientDescent):
    """Gradient descent on the mean over fields of sqrt(mean(r^2)) about the polychromatic centroid.

    The result is the lens of the smallest loss among steps with the full stop, since the loss sometimes rises abruptly
    and does not always recover; without such a step, the last finite lens.
    """

    def __init__(self, start: Lens, problem: Problem, settings: SpotSettings):
        super().__init__(start, problem, settings.steps, settings.learning_rates, betas=(0.9, 0.99))
        self.settings, self.least = settings, math.inf

    def step(self, step: int) -> Step:
        """Take a step of AdamW on the mean spot and the penalty, with the stop of this step."""
        settings, view = self.settings, self.problem.view
        lens = self.assemble()
        scale = geometric(settings.stop_scale, (step - 1) / (settings.stop_duration * self.steps))
        pupil = sobol_disc(settings.rays, self.problem.seed * self.steps + step)
        stopped = lens.with_stop_scaled(scale)
        rays = trace_fields(stopped, view, pupil)
        middle = centroid(rays)
        squared = (rays.x - middle[:, 0, None, None]) ** 2 + (rays.y - middle[:, 1, None, None]) ** 2
        spots = torch.where(rays.valid, squared, 1.0).mean((1, 2)).sqrt()  # a lost ray counts as 1 mm away
        bounds = self.penalty(lens)
        loss = spots.mean() / scale + settings.penalty * bounds
        if not torch.isfinite(loss):
            raise divergence(stopped, view, pupil, spots)
        if scale < 1 or loss.item() < self.least:
            self.remember()
            self.least = loss.item() if scale == 1 else math.inf
        loss.backward()
        self.advance()
        numbers = {"loss": loss.item(), "penalty": bounds.item(), "stop_scale": scale}
        return Step(rays, numbers | {"learning_rate": self.learning_rate})

    def state(self) -> dict[str, Any]:
        """Return the state of the gradient descent, and the smallest loss."""
        return super().state() | {"least": self.least}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Resume from `state`."""
        super().resume(state)
        self.least = state["least"]


def design(
    start: Lens, problem: Problem, settings: SpotSettings, checkpoint: Checkpoint = NO_CHECKPOINT
) -> tuple[Lens, History]:
    """Run a descent on the RMS spot from `start`; return the lens and its history."""
    return run(SpotDescent(start, problem, settings), "spot", checkpoint)
