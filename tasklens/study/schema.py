"""The JSON schema of study files, with which editors complete and check them; no torch here."""

from typing import Any

from tasklens.settings.design_methods import methods
from tasklens.settings.design_settings import PRESETS
from tasklens.settings.field_settings import NAMED
from tasklens.settings.tolerance_settings import GRADES
from tasklens.study.loading import EXTENDS
from tasklens.study.study import Study

_PLACE, _CHANGES = "#/$defs/", "Changed"  # prefix of the definitions of a study that extends another


def schema() -> dict[str, Any]:
    """Return the JSON schema of a study file: materials may be files; designs, rates, grades and fields may be names.

    A file with `extends` may have any part of a study; null removes an entry, and a mapping with the numbers of entries
    changes a list.
    """
    study = Study.model_json_schema()
    definitions = study.pop("$defs")
    del definitions["RankingSettings"]
    del study["properties"]["ranking"]  # only `tasklens rank` writes it
    materials = study["properties"]["materials"]
    named = {key: materials.pop(key) for key in ("type", "additionalProperties")}
    materials["anyOf"] = [{"type": "array", "items": {"type": "string"}}, named]
    by_name = study["properties"]["designs"]["patternProperties"]
    for pattern, design in by_name.items():
        by_name[pattern] = {"anyOf": [{"enum": list(methods())}, design]}
    for name, presets in (("LearningRates", PRESETS), ("Grade", GRADES), ("FieldSettings", NAMED)):
        definitions[name] = {"anyOf": [{"enum": list(presets)}, definitions[name]]}
    changes = _partial(study)
    changes["properties"]["extends"] = {"type": "string", "description": EXTENDS}
    partial = {f"{_CHANGES}{name}": _partial(definition) for name, definition in definitions.items()}
    return {"$defs": definitions | partial, "if": {"required": ["extends"]}, "then": changes, "else": study}


def _partial(schema: Any) -> Any:
    """Return the schema of changes of what a schema describes."""
    if isinstance(schema, list):
        return [_partial(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    changes = {
        "anyOf" if key == "oneOf" else key: _partial(value)
        for key, value in schema.items()
        if key not in ("required", "discriminator")
    }
    if isinstance(reference := changes.get("$ref"), str):
        changes["$ref"] = reference.replace(_PLACE, f"{_PLACE}{_CHANGES}")
    for key, entries in changes.get("patternProperties", {}).items():  # a section by names
        changes["patternProperties"][key] = {"anyOf": [entries, {"type": "null"}]}
    if changes.get("type") == "array" and isinstance(items := changes.get("items"), dict):
        by_number = {"type": "object", "patternProperties": {"^[0-9]+$": items}, "additionalProperties": False}
        return {"anyOf": [changes, by_number]}
    return changes
