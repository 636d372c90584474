"""The studies of all runs, in results/<study>/studies: a job takes the one that its rule was planned with.

Another run of a study of the same name may have other settings, and rewrites results/<study>/study.yaml at its start.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from tasklens.pipeline.stage import Plan, Stage, flatten, results, study_file
from tasklens.runtime.files import FileError, write_if_changed
from tasklens.study.loading import dump, load
from tasklens.study.study import Study, StudyError


def digest(plan: Plan) -> str:
    """Return the digest of a job's settings and of the names of its input files."""
    return _digest("\n".join([plan.settings.model_dump_json(), *map(str, flatten(plan.inputs))]))


def keep(study: Study) -> Path:
    """Keep a study for the jobs of a run, under a name that no other study has."""
    text = dump(study)
    path = Path(results(study), "studies", f"{_digest(text)}.yaml")
    write_if_changed(path, text)
    return path


def find(stage: Stage, study: Study, wildcards: Mapping[str, str | int], planned: str) -> Study:
    """Return the study that gives a job the plan of the digest `planned`: `study` itself, or a kept one.

    Raises:
        FileError: there is none.
    """
    for path in (None, *sorted(Path(results(study), "studies").glob("*.yaml"))):
        try:
            found = study if path is None else load(path)
            if digest(stage.plan(found, **wildcards)) == planned:
                return found
        except StudyError:  # of another version, or without this lens
            continue
    raise FileError(f"{study_file(study)}: not what this job was planned with; start the run again")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
