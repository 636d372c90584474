"""Gradient descent on the numbers of a lens with AdamW: what the methods that use it share."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from tasklens.design.constraints import penalty
from tasklens.design.driver import Descent
from tasklens.design.problem import Problem
from tasklens.design.schedule import cosine
from tasklens.design.variables import Variables, parameter_groups
from tasklens.optics.lens import Lens
from tasklens.study.design_settings import LearningRates


class GradientDescent(Descent):
    """A descent with AdamW on the variables of a lens, whose learning rates fall on a cosine.

    Args:
        start: the lens to begin with.
        problem: fields, limits, seed.
        steps: of the descent.
        rates: learning rates of the lens.
        groups: further parameters for the optimizer.
        betas: of AdamW.
        holders: what a subclass remembers beside optimizer and schedule.
    """

    def __init__(
        self,
        start: Lens,
        problem: Problem,
        steps: int,
        rates: LearningRates,
        groups: tuple[dict[str, Any], ...] = (),
        betas: tuple[float, float] = (0.9, 0.999),
        **holders: Any,
    ):
        self.problem, self.steps = problem, steps
        self.variables = Variables.stepped(start, problem.view, rates)
        self.values = {name: value.requires_grad_() for name, value in self.variables.values().items()}
        self.optimizer = torch.optim.AdamW([*parameter_groups(self.values, rates), *groups], betas=betas)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(
            self.optimizer, lambda step: cosine(step / steps, rates.final)
        )
        self.holders = {**holders, "optimizer": self.optimizer, "schedule": self.schedule}
        self.remembered = self.variables.values()

    def assemble(self) -> Lens:
        """The present lens, differentiable in its variables."""
        return self.variables.assemble(self.values)

    def penalty(self, lens: Lens) -> Tensor:
        """Sum of squared violations of the limits."""
        return penalty(lens, self.problem.limits, self.problem.view)

    def remember(self) -> None:
        """Remember the present lens."""
        self.remembered = {name: value.detach().clone() for name, value in self.values.items()}

    def revert(self) -> None:
        """Go back to the lens that was remembered last, or to the start."""
        for name, value in self.values.items():
            value.data.copy_(self.remembered[name])

    def advance(self) -> None:
        """Step along the gradients that have been accumulated, and clear them."""
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad()

    @property
    def learning_rate(self) -> float:
        """Of the first group, the curvatures."""
        return float(self.schedule.get_last_lr()[0])

    def state(self) -> dict[str, Any]:
        """Present and remembered variables."""
        return {"values": self.values, "remembered": self.remembered}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Take both from a state."""
        for name, value in self.values.items():
            value.data.copy_(state["values"][name])
        self.remembered = state["remembered"]

    def lens(self) -> Lens:
        """The present lens, out of every graph."""
        return self.assemble().detached()
