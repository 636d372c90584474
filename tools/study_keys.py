"""Write the page of all keys of a study file, from their descriptions: `python tools/study_keys.py`."""

import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from tasklens.study.study import RankingSettings, Study

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "study-file.md"
_HEAD = """\
# Keys of a study file

Unknown keys are refused, with the nearest known name. Lengths are in mm unless a key says otherwise. `NAME` stands for
a name of your choice. `tasklens study schema` prints the same for editors.
"""
_WORDS = {bool: "true or false", int: "whole number", float: "number", str: "text", Path: "path"}


def page() -> str:
    """Return the page as Markdown: a section for each group of keys."""
    return "\n".join([_HEAD, *(_section(path, model) for path, model in _models("", Study))])


def _models(path: str, model: type[BaseModel]) -> Iterator[tuple[str, type[BaseModel]]]:
    """Yield the path and the settings of each group of keys, outer groups first; groups of equal settings once each."""
    yield path, model
    for name, field in model.model_fields.items():
        if field.annotation is RankingSettings:  # only `tasklens rank` writes it
            continue
        inner = f"{path}.{name}".lstrip(".")
        for group, by_name in _nested(field.annotation):
            yield from _models(f"{inner}.NAME" if by_name else inner, group)


def _nested(annotation: Any, by_name: bool = False) -> Iterator[tuple[type[BaseModel], bool]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation, by_name
        return
    parts = typing.get_args(annotation)
    if typing.get_origin(annotation) is Annotated:
        parts = parts[:1]
    for part in parts:
        yield from _nested(part, by_name or typing.get_origin(annotation) is dict)


def _section(path: str, model: type[BaseModel]) -> str:
    method = model.model_fields.get("method")
    title = f"`{path}`" if path else "Top level"
    if method is not None:
        title += f" with `method: {typing.get_args(method.annotation)[0]}`"
    rows = [
        f"| `{name}` | {_kind(field.annotation)} | {_default(field)} | {_text(field.description or '')} |"
        for name, field in model.model_fields.items()
    ]
    head = ["| key | what | default | meaning |", "|---|---|---|---|"]
    return "\n".join([f"## {title}", "", _text((model.__doc__ or "").split("\n\n")[0]), "", *head, *rows, ""])


def _text(text: str) -> str:
    """Return a text in one line, for a cell of a table."""
    return " ".join(text.split()).replace("|", r"\|")


def _kind(annotation: Any) -> str:
    """Return in words what a key may be."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return _kind(parts[0])
    if origin is Literal:
        return " or ".join(f"`{part}`" for part in parts)
    if origin in (typing.Union, types.UnionType):
        kinds = dict.fromkeys(_kind(part) for part in parts if part is not type(None))
        return " or ".join(kinds)
    if origin in (tuple, list):
        kind = _kind(parts[0])
        return f"list: {kind}" if parts[-1] is Ellipsis else f"list of {len(parts)}: {kind}"
    if origin is dict:
        return f"by name: {_kind(parts[1])}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "keys below"
    return _WORDS.get(annotation, "any value")


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "*required*"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        return "as below"
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict | tuple) and not value:
        return "none"
    return f"{list(value) if isinstance(value, tuple) else value}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
