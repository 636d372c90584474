"""Errors for keys of older formats of study files, which name the keys of today; no torch here."""

from typing import Any

from pydantic import BaseModel, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError


def renamed(names: dict[str, str]) -> Any:
    """Return a validator that rejects keys of an older format and names their replacement.

    Args:
        names: new key by old key, or in more than one word what it is now, or why it is gone.
    """

    def refuse(cls: type[BaseModel], given: Any, handler: ModelWrapValidatorHandler) -> Any:
        found = [old for old in names if isinstance(given, dict) and old in given]
        if not found:
            return handler(given)
        problems: list[Any] = []
        for old in found:
            words = f"`{old}` is a key of an older format; it is now {names[old]}"
            problems.append({"type": "renamed", "msg": words, "loc": (old,), "input": given[old]})
        try:  # with the new names, to report other errors too
            handler({names.get(key, key): value for key, value in given.items() if " " not in names.get(key, "")})
        except ValidationError as error:
            problems += error.errors()
        details = [
            InitErrorDetails(type=PydanticCustomError(p["type"], p["msg"]), loc=p["loc"], input=p["input"])
            for p in problems
        ]
        raise ValidationError.from_exception_data(cls.__name__, details)

    return model_validator(mode="wrap")(classmethod(refuse))  # type: ignore[arg-type]
