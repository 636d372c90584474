"""Derivatives that are computed without a graph, and have no derivative themselves."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tasklens.runtime.errors import InputError

_REFUSED = "second derivatives of rays, PSFs and captures are not available; take differences of first ones"


class FirstDerivative(torch.autograd.Function):
    """Call a function that computes a derivative, and has none itself: a second derivative raises InputError.

    `torch.func` wraps the arguments of derivatives, but not those of a Function. All tensors that the derivative
    depends on are arguments, so that torch asks for its derivative, and does not take it for zero.
    """

    @staticmethod
    def forward(function: Callable[..., Any], *arguments: Tensor | None) -> Any:
        """Call the function."""
        outputs = function(*arguments)
        return tuple(outputs) if isinstance(outputs, list) else outputs

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Save nothing."""

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        """Raise InputError."""
        raise InputError(_REFUSED)

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor) -> Any:
        """Raise InputError."""
        raise InputError(_REFUSED)
