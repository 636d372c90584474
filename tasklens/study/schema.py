"""The JSON schema of study files, by which editors complete and check them; no torch here."""

from typing import Any

from tasklens.study.learning_rates import PRESETS
from tasklens.study.study import Study


def schema() -> dict[str, Any]:
    """Return the JSON schema of a study as a file spells it: materials also as files, learning rates also by name."""
    found = Study.model_json_schema()
    materials, rates = found["properties"]["materials"], found["$defs"]["LearningRates"]
    definitions = {key: materials.pop(key) for key in ("type", "additionalProperties")}
    materials["anyOf"] = [{"type": "array", "items": {"type": "string"}}, definitions]
    found["$defs"]["LearningRates"] = {"anyOf": [{"enum": list(PRESETS)}, rates]}
    return found
