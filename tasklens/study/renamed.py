"""Refusal of the keys of format 1 of study files, which names those of today; no torch here."""

from typing import Any

from pydantic import BaseModel, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError


def renamed(names: dict[str, str]) -> Any:
    """Return a validator that rejects keys of format 1 and names their replacement.

    Args:
        names: new key by old key; a sentence with the reason where the key was removed.
    """

    def refuse(cls: type[BaseModel], given: Any, handler: ModelWrapValidatorHandler) -> Any:
        found = [old for old in names if isinstance(given, dict) and old in given]
        if not found:
            return handler(given)
        problems: list[Any] = []
        for old in found:
            words = f"since format 2 `{old}` is {'gone: ' if ' ' in names[old] else 'now called '}{names[old]}"
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
