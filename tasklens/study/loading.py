"""Reading and writing of study files (YAML)."""

from collections.abc import Mapping
from functools import reduce
from pathlib import Path

import yaml
from pydantic import ValidationError

from tasklens.study.settings import Spec
from tasklens.study.study import Study, StudyError


def parse(config: Mapping) -> Study:
    """Validate a mapping and return the study.

    Raises:
        StudyError: names every wrong key, its value and what was expected.
    """
    try:
        return Study.model_validate(dict(config))
    except ValidationError as error:
        lines = []
        for item in error.errors():
            key = ".".join(str(part) for part in item["loc"]) or "study"
            value = item["input"]
            shown = f" = {value!r}" if not isinstance(value, dict) else ""
            lines.append(f"  {key}{shown}: {item['msg'].removeprefix('Value error, ')}")
        raise StudyError("the study cannot be run:\n" + "\n".join(lines)) from None


def read(path: str | Path) -> Mapping:
    """Read the keys of a study file; raises StudyError for a file that is no YAML mapping."""
    try:
        with open(path, encoding="utf-8") as file:
            content = yaml.safe_load(file)
    except yaml.YAMLError as error:
        raise StudyError(f"{path}: not valid YAML: {error}") from None
    if not isinstance(content, Mapping):
        raise StudyError(f"{path}: expected keys and values, found {type(content).__name__}")
    return content


def laid_over(below: Mapping, above: Mapping) -> dict:
    """Return one mapping laid over another as Snakemake does it: mappings key by key, all else replaced."""
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        merged[key] = laid_over(under, value) if isinstance(under, Mapping) and isinstance(value, Mapping) else value
    return merged


def load(*paths: str | Path) -> Study:
    """Read a study from YAML files, each laid over those before it; raises StudyError as `read` and `parse` do."""
    return parse(reduce(laid_over, map(read, paths)))


def dump(study: Study) -> str:
    """Return the resolved study as YAML, with all defaults."""
    computed = {"spec": set(Spec.model_computed_fields)}
    return yaml.safe_dump(study.model_dump(mode="json", exclude=computed), sort_keys=False)
