"""The JSON schema of study files, by which editors complete and check them; no torch here."""

from typing import Any

from tasklens.study.learning_rates import PRESETS
from tasklens.study.loading import EXTENDS
from tasklens.study.study import Study
from tasklens.study.tolerance_settings import GRADES


def schema() -> dict[str, Any]:
    """Return the JSON schema of a study as a file spells it: materials also as files, rates and grades also by name."""
    found = Study.model_json_schema()
    materials = found["properties"]["materials"]
    definitions = {key: materials.pop(key) for key in ("type", "additionalProperties")}
    materials["anyOf"] = [{"type": "array", "items": {"type": "string"}}, definitions]
    for name, known in (("LearningRates", PRESETS), ("Grade", GRADES)):
        found["$defs"][name] = {"anyOf": [{"enum": list(known)}, found["$defs"][name]]}
    found["properties"]["extends"] = {"type": "string", "description": EXTENDS}
    found["anyOf"] = [{"required": ["extends"]}, {"required": found.pop("required")}]
    return found
