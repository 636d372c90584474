"""Values of users that torch or numpy cannot compute with: one line that says what is possible."""

from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy
import torch
from torch import Tensor, nn
from torch.fx.experimental.proxy_tensor import get_proxy_mode

from tasklens.runtime.errors import InputError

_P = ParamSpec("_P")
_R = TypeVar("_R")

NO_VALUES = (
    "a tensor without values (device meta): a lens needs its values on the CPU, images and networks on any other device"
)
_EXPORT = (
    "optics cannot be exported or traced by torch: export the network alone; torch.export also takes a `PsfCamera`, "
    "whose PSFs are fixed"
)
_TRANSFORM = (
    "inside vmap or torch.func: take derivatives by backward(), torch.autograd.grad or torch.autograd.forward_ad, and "
    "use a loop in place of vmap; torch.func.grad and jvp take `trace` with a given `pupil`"
)


def explain_errors(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Replace an error of torch by an InputError if its reason is a kind of tensors that the function cannot take.

    It adds a call between the function and its caller, which `stacklevel` of warnings counts.
    """

    @wraps(function)
    def call(*arguments: _P.args, **options: _P.kwargs) -> _R:
        try:
            return function(*arguments, **options)
        except InputError:
            raise
        except Exception as error:
            if reason := _reason(error, (arguments, options)):
                name = function.__qualname__.lstrip("_").partition(".__")[0]
                raise InputError(f"{name}: {reason}") from error
            raise

    return call


def _reason(error: Exception, values: Any) -> str:
    """Return what is possible if an error has its reason in the kind of tensors in some values; empty if not."""
    tensors = list(_tensors(values))
    if torch.compiler.is_exporting() or torch.jit.is_tracing() or get_proxy_mode() is not None:
        return _EXPORT
    if any(tensor.is_meta or type(tensor).__name__ == "FakeTensor" for tensor in tensors):
        return NO_VALUES
    functorch = torch._C._functorch
    transformed = functorch.peek_interpreter_stack() is not None or any(map(functorch.is_legacy_batchedtensor, tensors))
    return _TRANSFORM if transformed or "vmap" in str(error) else ""


def _tensors(value: Any) -> Iterator[Tensor]:
    """Yield the tensors in a value: a module, an object of ours, or a collection of them."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, nn.Module):
        yield from value.parameters()
        yield from value.buffers()
    elif isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _tensors(part)
    elif type(value).__module__.startswith("tasklens."):
        yield from _tensors(vars(value))


def as_tensor(value: Any, name: str, dtype: torch.dtype | None = None) -> Tensor:
    """Return numbers as a tensor; arrays may have any byte order and strides.

    Raises:
        InputError: the value is not numbers; the message begins with `name`.
    """
    if isinstance(value, numpy.ndarray | numpy.generic):
        value = numpy.array(value, value.dtype.newbyteorder("="))
    try:
        return torch.as_tensor(value, dtype=dtype)
    except (TypeError, ValueError, RuntimeError) as error:
        kind = f"an array of {value.dtype}" if isinstance(value, numpy.ndarray) else type(value).__name__
        raise InputError(f"{name}: expected numbers, as a tensor, an array or a list, got {kind}") from error
