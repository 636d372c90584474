"""Errors for keys of older formats of study files; they name the present keys; no torch here."""

from typing import Any

from pydantic import BaseModel, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError


def renamed(names: dict[str, str]) -> Any:
    """Return a validator that rejects keys of an older format and names their replacement.

    Args:
        names: new key by old key; or, in more than one word, its replacement or the reason why it is gone.
    """

    def refuse(cls: type[BaseModel], values: Any, handler: ModelWrapValidatorHandler) -> Any:
        old_keys = [old for old in names if isinstance(values, dict) and old in values]
        if not old_keys:
            return handler(values)
        problems: list[Any] = []
        for old in old_keys:
            words = f"`{old}` is a key of an older format; it is now {names[old]}"
            problems.append({"type": "renamed", "msg": words, "loc": (old,), "input": values[old]})
        try:  # with the new names, to report other errors too
            handler({names.get(key, key): value for key, value in values.items() if " " not in names.get(key, "")})
        except ValidationError as error:
            problems += error.errors()
        details = [
            InitErrorDetails(type=PydanticCustomError(p["type"], p["msg"]), loc=p["loc"], input=p["input"])
            for p in problems
        ]
        raise ValidationError.from_exception_data(cls.__name__, details)

    return model_validator(mode="wrap")(classmethod(refuse))  # type: ignore[arg-type]
