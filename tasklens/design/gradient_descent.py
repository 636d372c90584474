"""Base class of methods with gradient descent on the variables of a lens by AdamW."""

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
from tasklens.study.learning_rates import LearningRates


class GradientDescent(Descent):
    """Gradient descent on the variables of a lens by AdamW, with cosine schedule of the learning rates.

    Args:
        start: starting lens.
        problem: fields, limits, seed.
        steps: number of steps.
        rates: learning rates of the lens.
        betas: betas of AdamW.
        holders: holders of a subclass, in addition to optimizer and schedule.
    """

    def __init__(
        self,
        start: Lens,
        problem: Problem,
        steps: int,
        rates: LearningRates,
        betas: tuple[float, float] = (0.9, 0.999),
        **holders: Any,
    ):
        self.problem, self.steps = problem, steps
        self.variables = Variables.for_learning_rates(start, problem.view, rates)
        self.values = {name: value.requires_grad_() for name, value in self.variables.values().items()}
        self.optimizer = torch.optim.AdamW(parameter_groups(self.values, rates), betas=betas)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(
            self.optimizer, lambda step: cosine(step / steps, rates.final)
        )
        self.holders = {**holders, "optimizer": self.optimizer, "schedule": self.schedule}
        self.remembered = self.variables.values()

    def assemble(self) -> Lens:
        """Return the present lens, differentiable in its variables."""
        return self.variables.assemble(self.values)

    def penalty(self, lens: Lens) -> Tensor:
        """Sum the squared violations of the limits."""
        return penalty(lens, self.problem.limits, self.problem.view)

    def remember(self) -> None:
        """Store the present variables."""
        self.remembered = {name: value.detach().clone() for name, value in self.values.items()}

    def advance(self) -> None:
        """Take a step of optimizer and schedule with the accumulated gradients, and clear them."""
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad()

    @property
    def learning_rate(self) -> float:
        """Present learning rate of the curvatures [1/mm]."""
        return float(self.schedule.get_last_lr()[0])

    def state(self) -> dict[str, Any]:
        """Return the present and the stored variables."""
        return {"values": self.values, "remembered": self.remembered}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Resume from `state`."""
        for name, value in self.values.items():
            value.data.copy_(state["values"][name])
        self.remembered = state["remembered"]

    def lens(self) -> Lens:
        """Return the lens with the stored variables, detached from autograd."""
        return self.variables.assemble(self.remembered).detached()
