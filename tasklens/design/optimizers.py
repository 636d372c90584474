"""Optimizers of a lens: steps of prescribed ray displacement, or AdamW on the parameters.

Both move the variables of a lens, concatenated in one vector (V,), and have `state_dict` and `load_state_dict` like
torch's optimizers. `change` computes a step and `apply` takes it, so that the caller can reject a step that is not
finite.
"""

import math
from typing import Any

import torch
from torch import Tensor

from tasklens.design.constraints import incidence_penalty, penalty
from tasklens.design.problem import Problem
from tasklens.design.ray_space import HARD, SOFT, RaySpace
from tasklens.design.variables import Variables, parameter_groups
from tasklens.optics.lens import Lens
from tasklens.settings.design_settings import DescentSettings

LEEWAY_MM = 0.05  # violation norm above which a lens is far outside its limits; and the increase that halves a step
_HALVINGS = 5  # maximum number of halvings of a step


def cosine(fraction: float, final: float) -> float:
    """Compute the factor on a rate after `fraction` of the steps: half a cosine from 1 to `final`."""
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(fraction, 1.0)))


class RaySpaceOptimizer:
    """Steps of prescribed ray displacement along the running mean of the gradient (see `ray_space`)."""

    def __init__(self, start: Lens, problem: Problem, settings: DescentSettings):
        self.settings, self.pitch = settings, problem.view.pixel_pitch_um
        self.space = RaySpace(start, problem.view, problem.limits, problem.free)
        self.values = self.space.start
        self.model = self.space.linearise(self.values)
        self.mean = torch.zeros_like(self.values)
        self.averaged = 0  # steps in the mean gradient
        self.factor = 1.0  # on the step size
        self.step_um = 0.0

    def vector(self) -> Tensor:
        """Return the current variables (V,), requiring grad."""
        return self.values.clone().requires_grad_()

    def lens(self, vector: Tensor) -> Lens:
        """Return the lens with these variables, differentiable in them."""
        return self.space.lens(vector)

    def violation(self) -> float:
        """Return the norm of the violation of the limits by the current lens [mm; fractions without unit]."""
        return self.model.violation_norm

    def change(self, vector: Tensor, lens: Lens, loss: Tensor, fraction: float, pixels: float) -> Tensor:
        """Compute the change (V,) of the variables; limits are hard once pixels have their last size.

        Args:
            vector, lens: variables from `vector`, and the lens with them.
            loss: scalar with the gradient of the loss.
            fraction: fraction of the steps that are complete.
            pixels: current pixel pitch [sensor pixels].
        """
        settings = self.settings
        (slope,) = torch.autograd.grad(loss, vector)
        self.mean = settings.momentum * self.mean + (1 - settings.momentum) * slope
        self.averaged += 1
        self.step_um = self.factor * settings.step_size * self.pitch * pixels
        if fraction > settings.duration:
            self.step_um *= cosine((fraction - settings.duration) / (1 - settings.duration), settings.final)
        # With soft limits, the final repair would cost more than the last steps gain.
        weight = HARD if pixels == settings.pixels[1] else SOFT
        mean = self.mean / (1 - settings.momentum**self.averaged)
        return self.model.step(mean, self.step_um, settings.damping, weight)

    def apply(self, change: Tensor) -> None:
        """Move by the change, halved while it increases the violation by more than `LEEWAY_MM`."""
        for halvings in range(_HALVINGS + 1):
            trial = self.values + change / 2**halvings
            model = self.space.linearise(trial)
            if model.violation_norm <= self.model.violation_norm + LEEWAY_MM:
                break
        self.values, self.model = trial, model

    def go_back(self, best: Tensor) -> None:
        """Go back to the best lens, and halve the step size: its largest useful value depends on sharpness."""
        self.values, self.model, self.factor = best, self.space.linearise(best), self.factor / 2
        self.mean, self.averaged = torch.zeros_like(self.mean), 0

    def numbers(self) -> dict[str, float]:
        """Return numbers of the current step for the history."""
        return {"step_size_um": self.step_um, "violation": self.model.violation_norm}

    def state_dict(self) -> dict[str, Any]:
        """Return variables, mean gradient and step size."""
        return {name: getattr(self, name) for name in ("values", "mean", "averaged", "factor")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from `state`, and linearise again."""
        vars(self).update(state)
        self.model = self.space.linearise(self.values)


class AdamWOptimizer:
    """AdamW on the parameters, with cosine schedule, and penalties on violated limits and angles of incidence."""

    def __init__(self, start: Lens, problem: Problem, settings: DescentSettings):
        self.settings, self.problem = settings, problem
        rates = settings.learning_rates
        if rates.normalised:
            self.variables = Variables.normalised(start, problem.view)
        else:
            self.variables = Variables.plain(start, problem.view)
        self.values = {name: value.requires_grad_() for name, value in self.variables.values().items()}
        self.free = self.variables.free(problem.free)
        self.optimizer = torch.optim.AdamW(parameter_groups(self.values, rates), betas=settings.betas)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(
            self.optimizer, lambda step: cosine(step / settings.steps, settings.final)
        )
        self.penalty = 0.0

    def vector(self) -> Tensor:
        """Return the current variables (V,), requiring grad."""
        return torch.cat(list(self.values.values()))

    def lens(self, vector: Tensor) -> Lens:
        """Return the lens with these variables, differentiable in them."""
        return self.variables.assemble_vector(list(self.values), vector)

    @torch.no_grad()
    def violation(self) -> float:
        """Return the norm of the violation of the limits by the current lens [mm; fractions without unit]."""
        return float(self._limits(self.lens(self.vector())).sqrt())

    def _limits(self, lens: Lens) -> Tensor:
        return penalty(lens, self.problem.limits, self.problem.view)

    def change(self, vector: Tensor, lens: Lens, loss: Tensor, fraction: float, pixels: float) -> Tensor:
        """Compute the gradient (V,) of loss and penalties; for arguments see `RaySpaceOptimizer.change`."""
        settings, penalties = self.settings, self._limits(lens)
        if settings.max_incidence_deg is not None:
            penalties = penalties + incidence_penalty(lens, self.problem.view, settings.max_incidence_deg)
        self.penalty = penalties.item()
        (loss + settings.penalty * penalties).backward()
        for value, free in zip(self.values.values(), self.free.chunk(len(self.values)), strict=True):
            value.grad = value.grad * free  # type: ignore[operator]  # a variable without gradient does not move
        return torch.cat([value.grad for value in self.values.values()])  # type: ignore[misc]

    def apply(self, change: Tensor) -> None:
        """Take a step of optimizer and schedule with the gradient, and clear it."""
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad()

    def go_back(self, best: Tensor) -> None:
        """Do nothing: the paper's protocol never goes back."""

    def numbers(self) -> dict[str, float]:
        """Return the learning rate of the curvatures [1/mm], and the penalty."""
        return {"learning_rate": float(self.schedule.get_last_lr()[0]), "penalty": self.penalty}

    def state_dict(self) -> dict[str, Any]:
        """Return variables, optimizer and schedule."""
        states = {"optimizer": self.optimizer.state_dict(), "schedule": self.schedule.state_dict()}
        return {"values": {name: value.detach() for name, value in self.values.items()}, **states}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from `state`."""
        for name, value in self.values.items():
            value.data.copy_(state["values"][name])
        self.optimizer.load_state_dict(state["optimizer"])
        self.schedule.load_state_dict(state["schedule"])


OPTIMIZERS: dict[str, type[RaySpaceOptimizer] | type[AdamWOptimizer]] = {
    "ray_space": RaySpaceOptimizer,
    "adamw": AdamWOptimizer,
}
