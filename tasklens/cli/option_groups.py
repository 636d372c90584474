"""Options that belong together, as one parameter of a command."""

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any


def with_options(**groups: Callable[..., Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that replaces parameters of a command by groups of options.

    Args:
        groups: by parameter, a data class or a function whose parameters are options, as typer declares them. The
            command gets the object, or what the function returns.
    """
    options = {name: inspect.signature(group, eval_str=True).parameters for name, group in groups.items()}

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True).parameters

        @wraps(command)
        def grouped(**values: Any) -> None:
            for name, group in groups.items():
                values[name] = group(**{option: values.pop(option) for option in options[name]})
            command(**values)

        parameters = [
            parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for name in own
            for parameter in (options[name].values() if name in options else [own[name]])
        ]
        grouped.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
        grouped.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return grouped

    return decorate
