"""The JSON schema of study files, with which editors complete and check them; no torch here."""

from typing import Any

from tasklens.study.learning_rates import PRESETS
from tasklens.study.loading import EXTENDS
from tasklens.study.study import Study
from tasklens.study.tolerance_settings import GRADES


def schema() -> dict[str, Any]:
    """Return the JSON schema of a study file, in which materials may be files, and rates and grades may be names."""
    result = Study.model_json_schema()
    materials = result["properties"]["materials"]
    definitions = {key: materials.pop(key) for key in ("type", "additionalProperties")}
    materials["anyOf"] = [{"type": "array", "items": {"type": "string"}}, definitions]
    for name, presets in (("LearningRates", PRESETS), ("Grade", GRADES)):
        result["$defs"][name] = {"anyOf": [{"enum": list(presets)}, result["$defs"][name]]}
    result["properties"]["extends"] = {"type": "string", "description": EXTENDS}
    result["anyOf"] = [{"required": ["extends"]}, {"required": result.pop("required")}]
    return result
