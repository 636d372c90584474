"""Messages about invalid settings, one line for each mistake, in the terms of the user's file; no torch here."""

import difflib
import re
from collections.abc import Iterable, Mapping
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from tasklens.runtime.errors import InputError

_Model = TypeVar("_Model", bound=BaseModel)
_LONGEST = 60  # characters of a value in a message
_KINDS = {  # expected values, by pydantic's types of errors
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "text",
    "path_type": "a path",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "keys and values",
    "model_type": "keys and values",
    "model_attributes_type": "keys and values",
    "dataclass_type": "keys and values",
    "string_pattern_mismatch": "a name of lower-case letters, digits and _",
    "invalid_key": "a key that is text",
    "path_not_file": "an existing file",
}
_REMOVED = {"processes": "no longer a key; several classifiers train at once instead (snakemake -j)"}


def problems(error: ValidationError, settings: Any) -> list[str]:
    """Return a line for each mistake in `settings`, a class or a union: key, value, and what was expected."""
    details = error.errors()
    places = [item["loc"] for item in details]
    return [
        _line(item, settings) for item in details if not (item["type"] == "too_short" and _inner(item["loc"], places))
    ]


def in_words(where: str, error: ValidationError, settings: Any) -> str:
    """Return all mistakes in one line, each key with the prefix `where`, if any."""
    return "; ".join(f"{where}.{line}" if where else line for line in problems(error, settings))


def validate(settings: type[_Model], values: Any, where: str = "") -> _Model:
    """Return settings from values; raises InputError with all mistakes in one line, keys with the prefix `where`."""
    try:
        return settings.model_validate(values)
    except ValidationError as error:
        raise InputError(in_words(where, error, settings)) from None


def missing_keys(error: ValidationError) -> list[str]:
    """Return the missing keys at the top level."""
    return [str(item["loc"][0]) for item in error.errors() if item["type"] == "missing" and len(item["loc"]) == 1]


def _inner(place: tuple, places: Iterable[tuple]) -> bool:
    """Return whether an entry below `place` is wrong; pydantic leaves such entries out of its count."""
    return any(len(other) > len(place) and other[: len(place)] == place for other in places)


def _line(item: ErrorDetails, settings: Any) -> str:
    keys, place = _walk(settings, item["loc"])
    kind, value = item["type"], item["input"]
    if kind == "missing":
        if isinstance(item["loc"][-1], int):
            return f"{'.'.join(keys[:-1])}: entry {item['loc'][-1] + 1} is missing"
        field = place.get(keys[-1])
        about = f": {field.description}" if field is not None and field.description else ""
        return f"{'.'.join(keys)}: missing{about}"
    if kind == "extra_forbidden":
        advice = _REMOVED.get(keys[-1]) or f"unknown key{suggestion(keys[-1], place)}"
        return f"{'.'.join(keys)}{_assignment(value)}: {advice}"
    message = _expectation(item)
    if re.split("[.:]", message)[0] in (place if keys else _fields(settings)):  # the message names a key itself
        return message
    suffix = "" if "[key]" in item["loc"] or kind == "invalid_key" else _assignment(value)
    return f"{'.'.join(keys)}{suffix}: {message}" if keys else message


def _expectation(item: ErrorDetails) -> str:
    if item["type"] in _KINDS:
        return f"expected {_KINDS[item['type']]}"
    if item["type"] == "too_short":
        return f"expected at least {item['ctx']['min_length']}, found {item['ctx']['actual_length']}"
    if item["type"] == "too_long":
        return f"expected at most {item['ctx']['max_length']}, found {item['ctx']['actual_length']}"
    if item["type"] == "string_too_long":
        return f"expected at most {item['ctx']['max_length']} characters, found {len(item['input'])}"
    message = item["msg"].removeprefix("Value error, ")
    return re.sub("^Input should be (a valid )?", "expected ", message)


def _assignment(value: Any) -> str:
    text = {"None": "null", "True": "true", "False": "false"}.get(repr(value), repr(value))  # as YAML has them
    return "" if isinstance(value, Mapping) or len(text) > _LONGEST else f" = {text}"


def suggestion(word: str, choices: Mapping[str, Any]) -> str:
    """Suggest the choice most similar to a wrong word, or the same word in a section of this place; else list all."""
    inside = {
        key: f"{name}.{key}" for name, field in choices.items() for key in _fields(getattr(field, "annotation", None))
    }
    nearest = difflib.get_close_matches(word, choices, 1)
    if not nearest and word in inside:
        nearest = [inside[word]]
    if nearest:
        return f"; did you mean {nearest[0]}?"
    return f"; expected one of {', '.join(choices)}" if choices else ""


def _walk(settings: Any, location: Iterable[str | int]) -> tuple[list[str], Mapping[str, Any]]:
    """Follow pydantic's location of a mistake.

    Returns:
        The keys in the user's file, without the tags of unions that a location also holds; and by key the fields of
        the settings that the last key belongs to.
    """
    keys: list[str] = []
    annotation = settings
    place: Mapping[str, Any] = {}
    for part in location:
        by_tag = _members_by_method(annotation)
        if part in by_tag:
            annotation = by_tag[str(part)]
            continue
        if part == "[key]":
            continue
        keys.append(str(part))
        place = _fields(annotation)
        annotation = place[str(part)].annotation if part in place else _inside(annotation)
    return keys, place


def _plain(annotation: Any) -> Any:
    """Return an annotation without its metadata, and without None."""
    while get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) in (Union, UnionType):
        members = [member for member in get_args(annotation) if member is not type(None)]
        if len(members) == 1:
            return _plain(members[0])
    return annotation


def _fields(annotation: Any) -> Mapping[str, Any]:
    """Return the fields of settings by key; empty for anything else."""
    model = _plain(annotation)
    return model.model_fields if isinstance(model, type) and issubclass(model, BaseModel) else {}


def _members_by_method(annotation: Any) -> dict[str, Any]:
    """Return the settings of a union by their `method`; empty for anything else."""
    union = _plain(annotation)
    if get_origin(union) not in (Union, UnionType):
        return {}
    methods = [(_fields(member).get("method"), member) for member in get_args(union)]
    tags = [(field.annotation, member) for field, member in methods if field is not None]
    return {get_args(tag)[0]: member for tag, member in tags if get_origin(tag) is Literal}


def _inside(annotation: Any) -> Any:
    """Return the annotation of the values of a mapping or sequence."""
    arguments = [argument for argument in get_args(_plain(annotation)) if argument is not Ellipsis]
    return arguments[-1] if arguments else None
