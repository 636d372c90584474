"""`tasklens study schema`: the JSON schema of study files, for editors."""

import json

from tasklens.study import schema as study_schema


def schema() -> None:
    """Print the JSON schema of study files, which editors use to complete and check them.

    With the YAML extension of VS Code: save it as study.schema.json, and begin a study file with

    # yaml-language-server: $schema=study.schema.json
    """
    print(json.dumps(study_schema.schema(), indent=2))
